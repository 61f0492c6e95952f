"""Command lines of `headway` that run in this process, and what they print."""

import io
import sys
from collections.abc import Sequence
from contextlib import redirect_stderr, redirect_stdout
from typing import NamedTuple

from headway_launch.commands.main import run


class Output(NamedTuple):
    """Output of a command."""

    out: str
    err: str


def _ended(words: Sequence[str]) -> tuple[int, Output]:
    out, err = io.BytesIO(), io.BytesIO()
    streams = [io.TextIOWrapper(kept, "utf-8", newline="", write_through=True) for kept in (out, err)]
    for stream, shown in zip(streams, (sys.stdout, sys.stderr), strict=True):
        stream.isatty = shown.isatty  # type: ignore[method-assign]  # a terminal if a test says so
    with redirect_stdout(streams[0]), redirect_stderr(streams[1]):
        code = run(words)
    return code, Output(out.getvalue().decode(), err.getvalue().decode())


def output(*words: str) -> Output:
    """Run a command that succeeds and return what it prints."""
    code, printed = _ended(words)
    assert code == 0, printed.err
    return printed


def rows_of(*words: str) -> list[list[str]]:
    """Run a command and return the cells of the table that it prints to a pipe, its header first."""
    return [line.split("\t") for line in output(*words).out.splitlines()]


def failed(*words: str) -> str:
    """Check that a command ends with exit code 2, and return what it prints to stderr."""
    code, printed = _ended(words)
    assert code == 2
    return printed.err


def refused(*words: str) -> str:
    """Check that a command is refused with exit code 2 and one line on stderr, and return that line."""
    line = failed(*words)
    assert line.startswith("headway: ")
    assert line.count("\n") == 1
    return line
