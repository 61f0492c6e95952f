"""Parallel training processes: start, events, stop requests and restart."""

import math
import signal
import time
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from multiprocessing.connection import wait
from types import FrameType
from typing import Any, Self

from headway.contracts.errors import HeadwayError
from headway.events import Event, Failed, Finished, Notice, Started
from headway.store.session import RunTakenError
from headway.timeouts import MIN_TIMEOUT_S, AdaptiveTimeout
from headway_launch.console.progress import OVER
from headway_launch.console.progress_display import Progress
from headway_launch.runner.cores import CoreShares
from headway_launch.runner.session_job import SessionJob
from headway_launch.runner.training_process import Training

_POLL_S = 0.2
_STOP_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
_SAME_REQUEST_S = 1.0
_SILENT_S = 3 * MIN_TIMEOUT_S
"""Minimum silence of a training process that is reported, s: it may be waiting for a worker and its
replacement."""
_STOP_S = 10.0
"""Minimum time that a training process has to report something after a stop request, s."""
_END_S = 30.0
"""Time that a training process has to end after its final event, s."""


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

    def __exit__(self, *error: object) -> None:
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


@dataclass
class _Running:
    """A job with its training process."""

    job: SessionJob
    training: Training
    silence: AdaptiveTimeout = field(default_factory=lambda: AdaptiveTimeout(factor=20.0, min_s=_SILENT_S))
    """Time between two events, and its limit. Not counted: the time before the first event, and after a
    notice, such as that of a replaced worker."""
    heard_at: float = field(default_factory=time.monotonic)
    """Time of its last event, s."""
    is_regular: bool = False
    """Whether the time since the last event counts towards `silence`."""
    is_noticed: bool = False
    """The user has been told that it is silent."""
    is_killed: bool = False

    def hear(self, event: Event) -> None:
        """Take note of an event."""
        now = time.monotonic()
        if self.is_regular and not isinstance(event, Notice | Started):
            self.silence.add(now - self.heard_at)
        self.heard_at, self.is_noticed, self.is_regular = now, False, not isinstance(event, Notice)

    @property
    def silent_s(self) -> float:
        """Seconds since its last event."""
        return time.monotonic() - self.heard_at

    def does_not_stop(self, asked_at: float) -> bool:
        """Return whether it has been silent for too long since it was asked to stop at `asked_at`.

        The limit is five times the longest silence so far. It is at least 10 s, or a minute when it has
        answered and writes its checkpoint. Before the second event it is 10 s: nothing is lost by then. There
        is no limit during the last evaluation, which may have any number of episodes.
        """
        progress = self.job.progress
        if progress.iteration >= progress.iterations:
            return False
        least = MIN_TIMEOUT_S if self.heard_at > asked_at else _STOP_S
        limit = max(least, 5 * self.silence.longest_s)
        return time.monotonic() - max(asked_at, self.heard_at) > limit

    def kill(self) -> None:
        """Kill its processes."""
        self.is_killed = True
        self.training.kill()


class Scheduler:
    """Runs the jobs of a session, `parallel` at a time. A failed job does not stop the others.

    Statuses of jobs change through the scheduler only. `start(job)` starts a training process;
    `ended(job)` is called when a job has ended or its process was lost; `tick()` is called a few times per
    second and returns lines for the user.
    """

    def __init__(
        self,
        jobs: Sequence[SessionJob],
        shares: CoreShares,
        start: Callable[[SessionJob], Training],
        ended: Callable[[SessionJob], None],
        tick: Callable[[], Sequence[str]],
    ) -> None:
        self._jobs, self._shares = jobs, shares
        self._start_training, self._ended, self._tick = start, ended, tick
        self._waiting = list(jobs)
        self._running: dict[int, _Running] = {}
        """By identity of the job."""
        self._asked_to_stop_at: float | None = None
        """Time of the stop request, s."""
        self._killed = False

    def run(self) -> bool:
        """Run all jobs; return whether a stop was requested.

        Leaves no training process behind, also if it raises.
        """
        parallel = self._shares.parallel
        try:
            with (
                StopRequests() as requests,
                Progress([job.progress for job in self._jobs], parallel) as shown,
            ):
                while self._running or (self._waiting and not requests.count):
                    while self._waiting and len(self._running) < parallel and not requests.count:
                        self._start(self._waiting.pop(0), shown)
                    self._receive_events(shown)
                    self._watch(shown)
                    self._handle_requests(requests, shown)
                    for line in self._tick():
                        shown.note(f"headway: {line}")
                    shown.show()
                return requests.count > 0
        finally:
            for running in self._running.values():
                running.kill()
                running.training.join()

    def _start(self, job: SessionJob, shown: Progress) -> None:
        job.progress.status = "starting"
        try:
            self._running[id(job)] = _Running(job, self._start_training(job))
        except RunTakenError as error:
            # Another session has begun these runs since this one was planned.
            job.progress.status, job.elsewhere = "elsewhere", error.directories
        except HeadwayError as error:
            self._take(job, Failed(str(error), traceback.format_exc()), shown)
        except OSError as error:  # too many processes or open files
            line = f"its training process cannot be started ({error.strerror}); lower backend.parallel"
            self._take(job, Failed(line, traceback.format_exc()), shown)

    def _receive_events(self, shown: Progress) -> None:
        """Process the events that have arrived, after waiting up to `_POLL_S` for the first."""
        by_handle: dict[Any, int] = {
            handle: key
            for key, running in self._running.items()
            for handle in (running.training.connection, running.training.sentinel)
        }
        for key in {by_handle[handle] for handle in wait(list(by_handle), _POLL_S)}:
            running = self._running[key]
            while running.training.has_event():
                event = running.training.receive()
                if event is None:
                    break
                running.hear(event)
                self._take(running.job, event, shown)
            if running.training.has_ended():
                del self._running[key]
                self._end(running, shown)

    def _watch(self, shown: Progress) -> None:
        """Tell the user of training processes that are silent; kill those that do not stop or do not end."""
        for running in self._running.values():
            name, silent = running.job.progress.name, running.silent_s
            if running.job.progress.status in OVER:
                if silent > _END_S and not running.is_killed:
                    running.kill()  # nothing is lost: its final event has arrived
            elif self._asked_to_stop_at is not None:
                if not running.is_killed and running.does_not_stop(self._asked_to_stop_at):
                    shown.note(f"{name} does not stop: killed; training after the last checkpoint is lost")
                    running.kill()
            elif silent > running.silence.limit_s and not running.is_noticed:
                running.is_noticed = True
                before = f"and for at most {running.silence.longest_s:.1f} s before"
                shown.note(
                    f"{name} has been silent for {silent:.0f} s, {before}; it may hang: Ctrl-C stops it"
                )

    def _take(self, job: SessionJob, event: Event, shown: Progress) -> None:
        progress = job.progress
        if isinstance(event, Failed) and event.lost and self._asked_to_stop_at is not None:
            # What stops the session, such as Slurm, may end workers and their cluster at the same time.
            shown.note(f"{progress.name} is stopped: {event.line}")
            event = Finished(progress.iteration, stopped=True)
        job.take(event)
        match event:
            case Failed(line=line):
                where = f"; see {progress.traceback}" if progress.traceback else ""
                shown.note(f"headway: {progress.name} failed: {line}{where}")
            case Notice(line=line):
                shown.note(f"{progress.name}: {line}")
        if progress.status in OVER:
            self._ended(job)

    def _end(self, running: _Running, shown: Progress) -> None:
        """Deal with the end of a training process, which may have sent no final event."""
        job, training, asked_to_stop = running.job, running.training, self._asked_to_stop_at is not None
        reason, progress = training.join(), job.progress
        if progress.status in OVER:
            return
        if training.lost and not asked_to_stop and job.can_restart():
            # The record and the energy account of the lost process are completed before the next one begins.
            progress.status = "stopped"
            self._ended(job)
            job.plan_restart(self._shares)
            shown.note(f"headway: {progress.name}: {reason}; restarted from its last checkpoint, if any")
            progress.status = "waiting"
            self._waiting.insert(0, job)
        elif running.is_killed or (training.lost and asked_to_stop):
            self._take(job, Finished(progress.iteration, stopped=True), shown)
        else:
            self._take(job, Failed(reason, ""), shown)

    def _handle_requests(self, requests: StopRequests, shown: Progress) -> None:
        if requests.count and self._asked_to_stop_at is None and self._running:
            self._asked_to_stop_at = time.monotonic()
            for running in self._running.values():
                running.training.ask_to_stop()
                if running.job.progress.status == "starting":
                    running.kill()  # nothing is lost: it has not begun to train
            if not all(running.is_killed for running in self._running.values()):
                shown.note(
                    "stopping after this iteration, with a checkpoint; press Ctrl-C again to kill at once"
                )
            requests.acknowledge()
        if requests.count > 1 and self._running:
            if not self._killed:
                shown.note("killed; training after the last checkpoint is lost")
            self._killed = True
            for running in self._running.values():
                running.kill()
