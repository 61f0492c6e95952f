"""Types of the fixtures with which tests run command lines in their own process."""

from collections.abc import Callable

Refused = Callable[..., str]
"""(words of a command) -> the line with which it is refused."""
RowsOf = Callable[..., list[list[str]]]
"""(words of a command) -> the cells of the table that it prints to a pipe, its header first."""
