"""The session's handle of a training process, and a training process on this machine."""

import os
import signal
import threading
import traceback
from abc import ABC, abstractmethod
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from multiprocessing import get_context, parent_process, resource_tracker
from multiprocessing.connection import Connection, wait
from typing import TYPE_CHECKING

from headway.contracts.errors import HeadwayError, WorkersLostError, one_line
from headway.events import Event, Failed
from headway.rollout.forks import end_if_forked, without_main_module

if TYPE_CHECKING:
    from headway.training.loop import TrainingJob

_SIGNALS = (signal.SIGINT, signal.SIGTERM)
_LAST_EVENT_S = 1.0

Report = Callable[[Event], None]
ShouldStop = Callable[[], bool]


class Training(ABC):
    """The session's handle of a training process on this machine or in a cluster."""

    lost = False
    """Whether Ray lost the process, for example with its machine: it can restart from a checkpoint."""

    def __init__(self, events: Connection) -> None:
        """`events`: pipe on which the events of the process arrive."""
        self._events, self._at_end = events, False

    @property
    def connection(self) -> Connection:
        """Pipe that is ready when an event has arrived or the process has ended."""
        return self._events

    @property
    def sentinel(self) -> Connection | int:
        """Object to wait on; ready when the process has ended."""
        return self._events

    def has_event(self) -> bool:
        """Return whether `receive` would return without waiting."""
        return not self._at_end and self._events.poll()

    def has_ended(self) -> bool:
        """Return whether no further event will arrive."""
        return self._at_end

    def receive(self) -> Event | None:
        """Return the next event; None once there are no more."""
        try:
            event: Event = self._events.recv()
        except (EOFError, OSError):  # OSError if killed while sending
            self._at_end = True
            return None
        return event

    @abstractmethod
    def ask_to_stop(self) -> None:
        """Request a checkpoint and an orderly end; no effect if the process has ended."""

    @abstractmethod
    def kill(self) -> None:
        """Kill the process and its workers."""

    @abstractmethod
    def join(self) -> str:
        """Wait for the process to end; return how it ended, as a message in case it sent no final event."""


class TrainingProcess(Training):
    """Runs one job in a separate process and process group, so that Ctrl-C reaches the session only."""

    def __init__(self, job: "TrainingJob") -> None:
        """Start the process."""
        context = get_context("spawn")
        events, child_end = context.Pipe()
        super().__init__(events)
        name = f"headway training {', '.join(str(seed) for seed in job.seeds)}"
        self._process = context.Process(target=_run, args=(child_end,), name=name)
        resource_tracker.ensure_running()
        # Signals stay blocked until the child has left the terminal's process group.
        signal.pthread_sigmask(signal.SIG_BLOCK, _SIGNALS)
        try:
            with without_main_module():  # a script that calls `run` would call it again
                self._process.start()
        finally:
            signal.pthread_sigmask(signal.SIG_UNBLOCK, _SIGNALS)
        child_end.close()
        # Not as an argument of the process: multiprocessing would wait for ever for a process that is killed
        # before it has read more than a pipe holds.
        with suppress(OSError):  # killed: `receive` finds the end of its pipe
            self._events.send(job)

    @property
    def sentinel(self) -> int:
        return self._process.sentinel

    def has_ended(self) -> bool:
        return self._at_end or (not self._process.is_alive() and not self._events.poll())

    def ask_to_stop(self) -> None:
        with suppress(OSError):
            self._events.send("stop")

    def kill(self) -> None:
        if self._process.pid is None or not self._process.is_alive():
            return
        try:
            os.killpg(self._process.pid, signal.SIGKILL)
        except ProcessLookupError:  # not yet leader of its group, or ended
            self._process.kill()

    def join(self) -> str:
        self._process.join(_LAST_EVENT_S)
        if self._process.is_alive():
            self.kill()
            self._process.join()
        self._events.close()
        code = self._process.exitcode or 0
        if code == -signal.SIGKILL:
            return "its training process was killed by SIGKILL (out of memory?); lower backend.parallel"
        if code < 0:
            return f"its training process was killed by signal {-code}"
        return f"its training process ended with exit code {code} and without a final event"


def _run(connection: Connection) -> None:
    os.setpgid(0, 0)
    with suppress(OSError):  # a closed stderr
        os.dup2(2, 1)  # what environments print is no result
    for number in _SIGNALS:
        # Not SIG_IGN: workers would inherit it and could not be terminated.
        signal.signal(number, lambda *_: None)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, _SIGNALS)
    threading.Thread(target=_end_with_session, daemon=True).start()
    try:
        job: TrainingJob = connection.recv()
        train_and_report(job, partial(_send, connection, os.getpid()), connection.poll)
    except EOFError:  # the session has ended
        _end_group()
    connection.close()


def _send(connection: Connection, process_id: int, event: Event) -> None:
    """Report an event, unless an environment forked this process off the training process."""
    end_if_forked(process_id)
    try:
        connection.send(event)
    except BrokenPipeError:  # the session has ended
        _end_group()


def train_and_report(job: "TrainingJob", report: Report, should_stop: ShouldStop) -> None:
    """Train a job; report an error as its final event."""
    from headway.training.loop import train

    try:
        train(job, report, should_stop)
    except BaseException as error:  # an environment may raise anything, and call sys.exit
        details = error.details if isinstance(error, HeadwayError) else ""
        lost = isinstance(error, WorkersLostError)
        report(Failed(one_line(error), f"{details}{traceback.format_exc()}", lost))


def _end_with_session() -> None:
    """Wait for the session's process to end, then kill this process group."""
    session = parent_process()
    if session is not None:
        wait([session.sentinel])
        _end_group()


def _end_group() -> None:
    os.killpg(0, signal.SIGKILL)
