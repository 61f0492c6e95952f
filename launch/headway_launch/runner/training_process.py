"""One training process as its session sees it: started, heard, asked to stop, and never left behind."""

import os
import signal
import sys
import threading
import traceback
from collections.abc import Callable
from functools import partial
from multiprocessing import get_context, parent_process, resource_tracker
from multiprocessing.connection import Connection, wait
from typing import TYPE_CHECKING

from headway.contracts.errors import HeadwayError
from headway.events import Event, Failed

if TYPE_CHECKING:
    from headway.training.loop import TrainingJob

_SIGNALS = (signal.SIGINT, signal.SIGTERM)
_LAST_EVENT_S = 1.0

Report = Callable[[Event], None]
ShouldStop = Callable[[], bool]
Work = Callable[[Report, ShouldStop], None]
"""What a training process does: it reports events, and stops where it should."""


class TrainingProcess:
    """Runs one job in a process, and process group, of its own, so that Ctrl-C reaches the session only."""

    lost = False
    """See `headway_launch.runner.scheduler.Training`: it does not die with its machine alone."""

    def __init__(self, job: "TrainingJob", work: Work | None = None) -> None:
        """`work`: what it does instead of training `job`, which names it then; picklable."""
        context = get_context("spawn")
        self._events, childs_end = context.Pipe()
        name = f"headway training {', '.join(str(seed) for seed in job.seeds)}"
        self._process = context.Process(
            target=_work, args=(work or partial(train_and_report, job), childs_end), name=name
        )
        resource_tracker.ensure_running()
        # Signals stay blocked until the child has left the terminal's process group.
        signal.pthread_sigmask(signal.SIG_BLOCK, _SIGNALS)
        try:
            self._process.start()
        finally:
            signal.pthread_sigmask(signal.SIG_UNBLOCK, _SIGNALS)
        childs_end.close()
        self._at_end = False

    @property
    def connection(self) -> Connection:
        """Ready to be waited for with `multiprocessing.connection.wait`."""
        return self._events

    @property
    def sentinel(self) -> int:
        """Ready to be waited for once the process is gone."""
        return self._process.sentinel

    def has_event(self) -> bool:
        """Whether `receive` returns at once."""
        return not self._at_end and self._events.poll()

    def has_ended(self) -> bool:
        """Whether nothing more will be heard."""
        return self._at_end or (not self._process.is_alive() and not self._events.poll())

    def receive(self) -> Event | None:
        """The next event, or None where the process has closed its end."""
        try:
            event: Event = self._events.recv()
        except (EOFError, OSError):  # OSError also where it was killed in the middle of an event
            self._at_end = True
            return None
        return event

    def ask_to_stop(self) -> None:
        """Ask for a checkpoint and an end; nothing happens if the process is already gone."""
        try:
            self._events.send("stop")
        except OSError:
            return

    def kill(self) -> None:
        """End the process and its workers at once."""
        if self._process.pid is None or not self._process.is_alive():
            return
        try:
            os.killpg(self._process.pid, signal.SIGKILL)
        except ProcessLookupError:  # not yet leader of its group, or gone
            self._process.kill()

    def join(self) -> str:
        """Wait for the end; say how it ended, for a process that gave no last event."""
        self._process.join(_LAST_EVENT_S)
        if self._process.is_alive():
            self.kill()
            self._process.join()
        self._events.close()
        code = self._process.exitcode or 0
        if code == -signal.SIGKILL:
            return "its training process was killed by SIGKILL (out of memory?); lower backend.parallel"
        if code < 0:
            return f"its training process was killed by {signal.Signals(-code).name}"
        return f"its training process ended with code {code} and no word"


def _work(work: Work, connection: Connection) -> None:
    os.setpgid(0, 0)
    for number in _SIGNALS:
        # A handler, not SIG_IGN: workers would inherit that and could not be terminated.
        signal.signal(number, lambda *_: None)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, _SIGNALS)
    threading.Thread(target=_end_with_session, daemon=True).start()
    try:
        work(connection.send, lambda: connection.poll())
    except BrokenPipeError:
        _end_group()
    connection.close()
    sys.stdout.flush()


def train_and_report(job: "TrainingJob", report: Report, should_stop: ShouldStop) -> None:
    """Train a job; what it fails of is its last event. Raises BrokenPipeError where nobody listens."""
    from headway.training.loop import train

    try:
        train(job, report, should_stop)
    except BrokenPipeError:
        raise
    except HeadwayError as error:
        report(Failed(str(error), f"{error.details}{traceback.format_exc()}"))
    except Exception as error:
        line = f"{type(error).__name__}: {error}".splitlines()[0]
        report(Failed(line, traceback.format_exc()))


def _end_with_session() -> None:
    session = parent_process()
    if session is not None:
        wait([session.sentinel])
        _end_group()


def _end_group() -> None:
    os.killpg(0, signal.SIGKILL)
