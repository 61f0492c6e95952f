"""Command lines of Headway in separate processes, and how they end."""

import os
import secrets
import signal
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Self

import psutil

from tests.robustness.outcomes import Outcome

ROOT = Path(__file__).resolve().parents[2]
BOUND_S = 300.0
"""Time that a small study may take on a busy machine."""
_GRACE_S = 60.0
"""Time that workers may take to end after their session."""
_MARK = "HEADWAY_CAMPAIGN"
_STOPPED = 130
TINY = (
    "energy=off", "evaluation.episodes=1", "evaluation.final_episodes=1", "evaluation.every=1000000",
    "evaluation.modes=[greedy]", "evaluation.rules=[]",
)  # fmt: skip


class Session:
    """Context manager of a command line in its own process group; it leaves no process behind.

    All processes that descend from it are found by a variable of their environment, orphans included.
    """

    def __init__(
        self,
        words: Sequence[str],
        folder: Path,
        environment: Mapping[str, str] | None = None,
        before: Sequence[str] = (),
    ) -> None:
        """`folder`: the working directory, which also gets the output. `before`: words of a command that runs
        the command line."""
        folder.mkdir(parents=True, exist_ok=True)
        self._mark = secrets.token_hex(8)
        self._output = [folder / f"{self._mark}.{name}" for name in ("out", "err")]
        variables = {**os.environ, _MARK: self._mark, **(environment or {})}
        paths = [str(ROOT), variables.get("PYTHONPATH", "")]
        variables["PYTHONPATH"] = os.pathsep.join(path for path in paths if path)
        with self._output[0].open("wb") as out, self._output[1].open("wb") as err:
            self.process = subprocess.Popen(
                [*before, *headway(words)], cwd=folder, env=variables, stdin=subprocess.DEVNULL, stdout=out,
                stderr=err, start_new_session=True,
            )  # fmt: skip

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._kill_all()

    @property
    def is_running(self) -> bool:
        """Return whether the session's own process is still running."""
        return self.process.poll() is None

    @property
    def out(self) -> str:
        """Return the text on stdout so far."""
        return self._output[0].read_text(errors="replace")

    @property
    def err(self) -> str:
        """Return the text on stderr so far."""
        return self._output[1].read_text(errors="replace")

    def processes(self) -> list[psutil.Process]:
        """Return all live processes of the session, itself and orphans included."""
        found = []
        for process in psutil.process_iter():
            with suppress(psutil.Error):
                if process.environ().get(_MARK) == self._mark and process.status() != psutil.STATUS_ZOMBIE:
                    found.append(process)
        return found

    def send(self, number: signal.Signals) -> None:
        """Send a signal to the session's process."""
        with suppress(ProcessLookupError):
            self.process.send_signal(number)

    def end(self, bound_s: float = BOUND_S) -> int | None:
        """Wait for the end of all its processes; return the exit code, None if some do not end in time."""
        try:
            code = self.process.wait(bound_s)
        except subprocess.TimeoutExpired:
            self._kill_all()
            return None
        deadline = time.monotonic() + _GRACE_S
        while self.processes():
            if time.monotonic() > deadline:
                self._kill_all()
                return None
            time.sleep(0.2)
        return code

    def _kill_all(self) -> None:
        while processes := self.processes():
            for process in processes:
                with suppress(psutil.Error):
                    process.kill()
            self.process.poll()
            psutil.wait_procs(processes, timeout=5)


def headway(words: Sequence[str]) -> list[str]:
    """Return the command that runs a command line of `headway`."""
    return [sys.executable, "-m", "headway_launch", *words]


def session_outcome(code: int | None, errors: str, sent: Sequence[signal.Signals] = ()) -> Outcome:
    """Classify the end of a session that shows its progress; `sent`: signals that were sent to it."""
    if code is None:
        return Outcome.HUNG
    if "Traceback" in errors or "unexpected " in errors:  # not multiprocessing's "died unexpectedly"
        return Outcome.UNEXPECTED
    if code == 0 or (sent and code in (_STOPPED, *(-number for number in sent))):
        return Outcome.ACCEPTED
    return Outcome.CLEAR if code in (1, 2) and error_lines(errors) else Outcome.UNEXPECTED


def error_lines(errors: str) -> list[str]:
    """Return the lines that say what failed."""
    lines = [line for line in errors.splitlines() if line.startswith("headway: ")]
    failed = [line for line in lines if " failed: " in line]
    return failed or [line for line in lines if "to continue:" not in line]
