"""A session: training processes side by side, heard until the last of them has ended."""

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
    """Counts Ctrl-C, SIGTERM and SIGHUP instead of dying of them, while it is entered. Signals within a
    second of one that counted are the same request: a key pressed twice, a parent that passes on its own.
    After the first request only Ctrl-C counts: who sends the others again was not told what that does."""

    def __init__(self) -> None:
        self.count = 0
        self._counted_at = -math.inf
        self._before: dict[signal.Signals, Any] = {}

    def __enter__(self) -> Self:
        for number in _STOP_SIGNALS:
            self._before[number] = signal.signal(number, self._note)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def told(self) -> None:
        """The first request has been answered on the screen: whatever came before that was the same one."""
        self.count, self._counted_at = 1, time.monotonic()

    def _note(self, number: int, frame: FrameType | None) -> None:
        moment = time.monotonic()
        if self.count and number != signal.SIGINT:
            return
        if moment - self._counted_at >= _SAME_REQUEST_S:
            self.count += 1
            self._counted_at = moment


class Training(Protocol):
    """One training process, wherever it is."""

    @property
    def lost(self) -> bool:
        """It was lost with what it ran on, and may go on elsewhere."""
        ...

    @property
    def connection(self) -> Any:  # noqa: ANN401 - whatever `multiprocessing.connection.wait` takes
        """Ready to be waited for: an event, or the end."""
        ...

    @property
    def sentinel(self) -> Any:  # noqa: ANN401 - the same
        """Ready to be waited for once it is gone."""
        ...

    def has_event(self) -> bool:
        """Whether `receive` returns at once."""
        ...

    def has_ended(self) -> bool:
        """Whether nothing more will be heard."""
        ...

    def receive(self) -> Event | None:
        """The next event, or None where there will be none."""
        ...

    def ask_to_stop(self) -> None:
        """Ask for a checkpoint and an end."""
        ...

    def kill(self) -> None:
        """End it and its workers at once."""
        ...

    def join(self) -> str:
        """Wait for the end; say how it ended, for one that gave no last event."""
        ...


class Scheduler:
    """Runs jobs, `parallel` at a time, made by `begin(index)` when their turn comes. Every event goes to
    `take(index, event)`; `tick` is called a few times a second. A job that fails does not stop the others."""

    def __init__(
        self,
        progress: Sequence[JobProgress],
        parallel: int,
        begin: Callable[[int], "TrainingJob"],
        take: Callable[[int, Event], None],
        tick: Callable[[], Sequence[str]] = tuple,
        open_training: Callable[["TrainingJob"], Training] = TrainingProcess,
        goes_on: Callable[[int], bool] = lambda index: False,
    ) -> None:
        """`goes_on(index)` is asked of a job whose training process was lost, and begins again if it says
        so."""
        self._begin = begin
        self._progress = progress
        self._parallel = parallel
        self._take = take
        self._tick = tick
        self._open_training, self._goes_on = open_training, goes_on
        self._running: dict[int, Training] = {}
        self._waiting = list(range(len(progress)))
        self._asked_to_stop = False
        self._killed = False

    def run(self) -> bool:
        """Train everything; returns whether the session was asked to stop. Whatever is raised, no training
        process is left."""
        try:
            with StopRequests() as requests, Progress(self._progress, self._parallel) as shown:
                while self._running or (self._waiting and not requests.count):
                    while self._waiting and len(self._running) < self._parallel and not requests.count:
                        self._start(self._waiting.pop(0), shown)
                    self._hear(shown)
                    self._obey(requests, shown)
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

    def _hear(self, shown: Progress) -> None:
        """Take the events that have arrived, waiting a moment if there are none."""
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
                shown.note(f"headway: {job.name} failed: {line}")
            case Notice(line=line):
                shown.note(f"{job.name}: {line}")
        self._take(index, event)

    def _end(self, index: int, shown: Progress) -> None:
        training = self._running.pop(index)
        how = training.join()
        job = self._progress[index]
        unfinished = job.status in ("starting", "training")
        if unfinished and training.lost and not self._asked_to_stop and self._goes_on(index):
            shown.note(f"headway: {job.name}: {how}; it goes on elsewhere from its last checkpoint")
            job.status = "waiting"
            self._waiting.insert(0, index)
            return
        if unfinished:
            last = Finished(job.iteration, stopped=True) if self._killed else Failed(how, "")
            self._take_event(index, last, shown)

    def _obey(self, requests: StopRequests, shown: Progress) -> None:
        if requests.count and not self._asked_to_stop and self._running:
            self._asked_to_stop = True
            for process in self._running.values():
                process.ask_to_stop()
            shown.note("stopping after this iteration, with a checkpoint; Ctrl-C again kills at once")
            requests.told()
        if requests.count > 1 and self._running:
            if not self._killed:
                shown.note("killed; what came after the last checkpoint is lost")
            self._killed = True
            for process in self._running.values():
                process.kill()
