"""Terminal output that survives a closed pipe, as in `headway run 2>&1 | head`."""

import os
import shutil
import sys
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stdout, suppress
from contextvars import ContextVar
from pathlib import Path
from typing import TextIO
from unicodedata import category

_NOTICED: ContextVar[set[str]] = ContextVar("noticed")


def print_line(line: str) -> None:
    """Print a line on stderr, `visible`; write errors are ignored, now and later."""
    try:
        print(visible(line), file=sys.stderr, flush=True)
    except OSError:
        silence(sys.stderr)


def print_notice(line: str) -> None:
    """Print a line on stderr, within `distinct_notices` only the first time."""
    noticed = _NOTICED.get(set())
    if line not in noticed:
        noticed.add(line)
        print_line(f"headway: {line}")


@contextmanager
def distinct_notices() -> Iterator[None]:
    """Print each notice once: cells of a sweep, and rungs of a search, have some in common."""
    token = _NOTICED.set(set())
    try:
        yield
    finally:
        _NOTICED.reset(token)


def visible(text: str) -> str:
    """Write control and format characters, other than line breaks and tabs, as escapes.

    They could otherwise change the terminal, or what a reader sees of the line.
    """
    return "".join(
        char.encode("unicode_escape").decode()
        if category(char) in ("Cc", "Cf", "Cs") and char not in "\n\t"
        else char
        for char in text
    )


@contextmanager
def prints_to_stderr() -> Iterator[None]:
    """Send what an environment prints to stderr: stdout holds results only."""
    with redirect_stdout(sys.stderr):
        yield


def own_name() -> str:
    """Return the command to type: `headway` if it is on the PATH, else its path."""
    if shutil.which("headway"):
        return "headway"
    return relative(Path(sys.executable).with_name("headway"))


def relative(path: Path) -> str:
    """Return a path as a reader would type it: relative to the working directory if that contains it."""
    return str(path.relative_to(Path.cwd())) if path.is_relative_to(Path.cwd()) else str(path)


@contextmanager
def ignore_closed_pipe(stream: TextIO) -> Iterator[None]:
    """Discard the rest of the output if the stream's pipe is closed."""
    try:
        yield
        stream.flush()
    except BrokenPipeError:
        silence(stream)


def silence(stream: TextIO) -> None:
    """Redirect a stream to the null device, including buffered output."""
    # Python's manual advises this: the interpreter flushes a broken stream at exit, which would fail again.
    with suppress(OSError, ValueError):
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, stream.fileno())
        os.close(nowhere)


def exit_of_environment(error: SystemExit) -> str:
    """Return the error line for an environment's code that tried to end the process."""
    return f"the environment's code called sys.exit({error.code!r}); raise an error there instead"
