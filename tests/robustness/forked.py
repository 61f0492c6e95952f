"""Command lines in forked children of a process that has imported everything, with bounds."""

import gc
import os
import resource
import select
import signal
import sys
import traceback
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import NoReturn

from headway_launch.commands.main import run
from tests.robustness.outcomes import Ended

_MEMORY, _FILE = 4 << 30, 1 << 30
"""Bytes that a command may map in addition to what this process has, and write to one file."""


def run_forked(words: Sequence[str], folder: Path, seconds: float, scratch: Path) -> Ended:
    """Run `headway WORDS` in `folder`; after `seconds` it is stopped. `scratch` holds its output."""
    output, errors = scratch / "stdout", scratch / "stderr"
    sys.stdout.flush()
    child = os.fork()
    if child == 0:
        _run_and_exit(words, folder, output, errors)
    descriptor = os.pidfd_open(child)
    try:
        ended = bool(select.select([descriptor], [], [], seconds)[0])
    finally:
        os.close(descriptor)
        with suppress(ProcessLookupError):  # no process of its session stays behind
            os.killpg(child, signal.SIGKILL)
        with suppress(ProcessLookupError):  # it may not have become a leader yet
            os.kill(child, signal.SIGKILL)
        _, status = os.waitpid(child, 0)
    code = os.waitstatus_to_exitcode(status) if ended else None
    return Ended(code, errors.read_text(encoding="utf-8", errors="replace"))


def _run_and_exit(words: Sequence[str], folder: Path, output: Path, errors: Path) -> NoReturn:
    code = 70
    try:
        gc.freeze()
        os.setsid()
        for descriptor, path, flags in (
            (0, Path(os.devnull), os.O_RDONLY),
            (1, output, os.O_WRONLY | os.O_CREAT | os.O_TRUNC),
            (2, errors, os.O_WRONLY | os.O_CREAT | os.O_TRUNC),
        ):
            os.dup2(os.open(path, flags, 0o600), descriptor)
        # A separate process has these encodings; pytest and others may have replaced the streams. Open
        # until the child ends, hence no `with`.
        sys.stdout = open(1, "w", encoding="utf-8", closefd=False)  # noqa: SIM115 - see above
        sys.stderr = open(2, "w", encoding="utf-8", errors="backslashreplace", closefd=False)  # noqa: SIM115
        os.chdir(folder)
        mapped = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (mapped + _MEMORY,) * 2)
        resource.setrlimit(resource.RLIMIT_FSIZE, (_FILE,) * 2)
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        code = run(words)
        sys.stdout.flush()
    except SystemExit as done:
        code = done.code if isinstance(done.code, int) else 1
    except BaseException:
        traceback.print_exc()
    finally:
        with suppress(BaseException):
            sys.stderr.flush()
        os._exit(code)
