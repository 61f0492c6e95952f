"""Types of the fixtures with which tests run command lines in their own process."""

from collections.abc import Callable
from typing import NamedTuple

Refused = Callable[..., str]
"""(words of a command) -> the line with which it is refused."""
RowsOf = Callable[..., list[list[str]]]
"""(words of a command) -> the cells of the table that it prints to a pipe, its header first."""


class Output(NamedTuple):
    """Output of a command."""

    out: str
    err: str


RunOutput = Callable[..., Output]
"""(words of a command that succeeds) -> its output."""
