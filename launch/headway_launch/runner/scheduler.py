"""Parallel training processes: start, events, stop requests and restart."""

import math
import signal
import time
import traceback
from collections.abc import Callable, Sequence
from multiprocessing.connection import wait
from types import FrameType, TracebackType
from typing import TYPE_CHECKING, Any, Protocol, Self

from headway.contracts.errors import HeadwayError
from headway.events import Event, Failed, Finished, Notice
from headway_launch.console.progress import JobProgress
from headway_launch.console.progress_display import Progress
from headway_launch.runner.training_process import TrainingProcess

if TYPE_CHECKING:
    from headway.training.loop import TrainingJob

_POLL_S = 0.2
_STOP_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
_SAME_REQUEST_S = 1.0


class StopRequests:
    """Context manager that counts Ctrl-C, SIGTERM and SIGHUP as stop requests instead of ending the process.

    Signals within a second of a counted one belong to the same request. After the first request only Ctrl-C
    counts, because the effect of a second request is announced on the screen only.
    """

    def __init__(self) -> None:
        self.count = 0
        self._counted_at = -math.inf
        self._before: dict[signal.Signals, Any] = {}

    def __enter__(self) -> Self:
        for number in _STOP_SIGNALS:
            self._before[number] = signal.signal(number, self._count_signal)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def acknowledge(self) -> None:
        """Count all requests so far as one; to be called once the first has been announced on the screen."""
        self.count, self._counted_at = 1, time.monotonic()

    def _count_signal(self, number: int, frame: FrameType | None) -> None:
        now = time.monotonic()
        if self.count and number != signal.SIGINT:
            return
        # A double key press, or a signal that the parent process forwards, arrives twice.
        if now - self._counted_at >= _SAME_REQUEST_S:
            self.count += 1
            self._counted_at = now


class Training(Protocol):
    """Interface to a training process on this machine or in a cluster."""

    @property
    def lost(self) -> bool:
        """Whether Ray lost the process, for example with its machine: it can restart from a checkpoint."""
        ...

    @property
    def connection(self) -> Any:  # noqa: ANN401 - any object `multiprocessing.connection.wait` takes
        """Object to wait on; ready when an event has arrived or the process has ended."""
        ...

    @property
    def sentinel(self) -> Any:  # noqa: ANN401 - as `connection`
        """Object to wait on; ready when the process has ended."""
        ...

    def has_event(self) -> bool:
        """Return whether `receive` would return without waiting."""
        ...

    def has_ended(self) -> bool:
        """Return whether no further event will arrive."""
        ...

    def receive(self) -> Event | None:
        """Return the next event; None once there are no more."""
        ...

    def ask_to_stop(self) -> None:
        """Request a checkpoint and an orderly end."""
        ...

    def kill(self) -> None:
        """Kill the process and its workers."""
        ...

    def join(self) -> str:
        """Wait for the end; return how the process ended, for one that sent no final event."""
        ...


class Scheduler:
    """Runs jobs, `parallel` at a time.

    `begin(index)` returns a job when its turn comes, `take(index, event)` receives every event, and `tick` is
    called a few times per second. A failed job does not stop the others.
    """

    def __init__(
        self,
        progress: Sequence[JobProgress],
        parallel: int,
        begin: Callable[[int], "TrainingJob"],
        take: Callable[[int, Event], None],
        tick: Callable[[], Sequence[str]] = tuple,
        open_training: Callable[["TrainingJob"], Training] = TrainingProcess,
        should_restart: Callable[[int], bool] = lambda index: False,
    ) -> None:
        """`should_restart(index)` decides whether a job whose training process was lost is started again."""
        self._begin = begin
        self._progress = progress
        self._parallel = parallel
        self._take = take
        self._tick = tick
        self._open_training, self._should_restart = open_training, should_restart
        self._running: dict[int, Training] = {}
        self._waiting = list(range(len(progress)))
        self._asked_to_stop = False
        self._killed = False

    def run(self) -> bool:
        """Run all jobs; return whether a stop was requested.

        Leaves no training process behind, also if it raises.
        """
        try:
            with StopRequests() as requests, Progress(self._progress, self._parallel) as shown:
                while self._running or (self._waiting and not requests.count):
                    while self._waiting and len(self._running) < self._parallel and not requests.count:
                        self._start(self._waiting.pop(0), shown)
                    self._receive_events(shown)
                    self._handle_requests(requests, shown)
                    for line in self._tick():
                        shown.note(f"headway: {line}")
                    shown.show()
                return requests.count > 0
        finally:
            for process in self._running.values():
                process.kill()
                process.join()

    def _start(self, index: int, shown: Progress) -> None:
        self._progress[index].status = "starting"
        try:
            self._running[index] = self._open_training(self._begin(index))
        except HeadwayError as error:
            self._take_event(index, Failed(str(error), traceback.format_exc()), shown)

    def _receive_events(self, shown: Progress) -> None:
        """Process the events that have arrived, after waiting up to `_POLL_S` for the first."""
        by_handle: dict[Any, int] = {
            handle: index
            for index, process in self._running.items()
            for handle in (process.connection, process.sentinel)
        }
        for index in {by_handle[handle] for handle in wait(list(by_handle), _POLL_S)}:
            process = self._running[index]
            while process.has_event():
                event = process.receive()
                if event is None:
                    break
                self._take_event(index, event, shown)
            if process.has_ended():
                self._end(index, shown)

    def _take_event(self, index: int, event: Event, shown: Progress) -> None:
        job = self._progress[index]
        job.take(event)
        match event:
            case Finished(stopped=stopped):
                job.status = "stopped" if stopped else "finished"
            case Failed(line=line):
                job.status = "failed"
                where = f"; see {job.traceback}" if job.traceback else ""
                shown.note(f"headway: {job.name} failed: {line}{where}")
            case Notice(line=line):
                shown.note(f"{job.name}: {line}")
        self._take(index, event)

    def _end(self, index: int, shown: Progress) -> None:
        training = self._running.pop(index)
        reason = training.join()
        job = self._progress[index]
        unfinished = job.status in ("starting", "training")
        if unfinished and training.lost and not self._asked_to_stop and self._should_restart(index):
            shown.note(f"headway: {job.name}: {reason}; restarted from its last checkpoint, if any")
            job.status = "waiting"
            self._waiting.insert(0, index)
            return
        if unfinished:
            last = Finished(job.iteration, stopped=True) if self._killed else Failed(reason, "")
            self._take_event(index, last, shown)

    def _handle_requests(self, requests: StopRequests, shown: Progress) -> None:
        if requests.count and not self._asked_to_stop and self._running:
            self._asked_to_stop = True
            for process in self._running.values():
                process.ask_to_stop()
            shown.note("stopping after this iteration, with a checkpoint; press Ctrl-C again to kill at once")
            requests.acknowledge()
        if requests.count > 1 and self._running:
            if not self._killed:
                shown.note("killed; training after the last checkpoint is lost")
            self._killed = True
            for process in self._running.values():
                process.kill()
