"""Words for a reader who may have gone: `headway run 2>&1 | head`."""

import os
import shutil
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TextIO


def print_line(line: str) -> None:
    """Print a line on stderr; nothing happens, now or later, if it cannot be written."""
    try:
        print(line, file=sys.stderr, flush=True)
    except OSError:
        silence(sys.stderr)


def own_name() -> str:
    """What to type for this command here: `headway` where the shell finds it, else its path."""
    if shutil.which("headway"):
        return "headway"
    script = Path(sys.executable).with_name("headway")
    return str(script.relative_to(Path.cwd())) if script.is_relative_to(Path.cwd()) else str(script)


@contextmanager
def to_a_reader(stream: TextIO) -> Iterator[None]:
    """Print to a stream of which the reader may go: then the rest is left out."""
    try:
        yield
        stream.flush()
    except BrokenPipeError:
        silence(stream)


def silence(stream: TextIO) -> None:
    """Let whatever is, or waits to be, written to a stream vanish."""
    # Python's manual advises this; a stream left broken fails again when the interpreter flushes it.
    with suppress(OSError, ValueError):
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, stream.fileno())
        os.close(nowhere)
