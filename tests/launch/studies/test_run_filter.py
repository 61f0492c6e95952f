"""Which texts of parameters are numbers."""

import pytest

from headway_launch.studies.run_filter import as_number


@pytest.mark.parametrize("number", [0, -7, 10, 10**30, 0.5, -0.001, 3e-05, 1e20])
def test_what_str_writes_of_a_number_is_that_number(number: float) -> None:
    read = as_number(str(number))
    assert (read, type(read)) == (number, type(number))


@pytest.mark.parametrize("text", ["2024_01", "1_0.5", "007", "-01", "00.5", "9" * 400, "9" * 5000, "inf"])
def test_other_text_stays_text(text: str) -> None:
    assert as_number(text) == text
