"""Errors as one line."""

import pytest

from headway.contracts import HeadwayError
from headway.contracts.errors import EnvironmentRaisedError, one_line

_LOWER = "; lower sizes, such as rollout.copies, rollout.steps, backend.stack or the environment's own"


@pytest.mark.parametrize(
    ("error", "line"),
    [
        (HeadwayError("give another name"), "give another name"),
        (ValueError("no state\nsecond line"), "ValueError: no state"),
        (MemoryError(), f"MemoryError: this needs more memory than is free{_LOWER}"),
        (
            EnvironmentRaisedError("game", "step", MemoryError()),
            f"environment 'game' raised MemoryError: this needs more memory than is free{_LOWER} in step",
        ),
    ],
)
def test_an_error_is_one_line(error: Exception, line: str) -> None:
    assert one_line(error) == line
