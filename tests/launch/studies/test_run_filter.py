"""Texts of parameters that are numbers, and names that look like other values."""

from pathlib import Path

import pytest
from stored_runs import keep

from headway.store.index import RunIndex
from headway_launch.studies.run_filter import as_number, filter_runs


@pytest.mark.parametrize("number", [0, -7, 10, 10**30, 0.5, -0.001, 3e-05, 1e20])
def test_what_str_writes_of_a_number_is_that_number(number: float) -> None:
    read = as_number(str(number))
    assert (read, type(read)) == (number, type(number))


@pytest.mark.parametrize("text", ["2024_01", "1_0.5", "007", "-01", "00.5", "9" * 400, "9" * 5000, "inf"])
def test_other_text_stays_text(text: str) -> None:
    assert as_number(text) == text


@pytest.mark.parametrize("name", ["true", "null", "7", "007", "1e3", "2024.10"])
def test_a_study_may_have_the_name_of_a_value(name: str, tmp_path: Path) -> None:
    for study in (name, "other"):
        keep(tmp_path, study, 0, "trivial", "ippo", "cell")
    rows = RunIndex(tmp_path).rows()
    assert [row.study for row in filter_runs(rows, [f"study={name}"])] == [name]
    assert [row.study for row in filter_runs(rows, [f"seed=0 and study!={name}"])] == ["other"]
