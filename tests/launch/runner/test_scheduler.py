"""The scheduler and training processes that hang."""

import errno
import signal
import time
from collections.abc import Callable, Sequence
from multiprocessing import Pipe
from types import SimpleNamespace
from typing import Any, cast

import pytest

from headway.events import Event, Failed, Finished, IterationFinished, Started, Usage
from headway_launch.console.progress import JobProgress
from headway_launch.runner import scheduler
from headway_launch.runner.cores import CoreShares
from headway_launch.runner.scheduler import Scheduler
from headway_launch.runner.session_job import SessionJob
from headway_launch.runner.training_process import Training

BEGUN = (Started(0, (1,)), IterationFinished(1, 64, Usage(), 1.0, 0.5, 0.5))


class _Silent(Training):
    """A training process that has sent some events and does nothing more until it is killed."""

    def __init__(self, events: Sequence[Event] = BEGUN) -> None:
        ours, self.theirs = Pipe()
        super().__init__(ours)
        self.asked = self.killed = False
        for event in events:
            self.theirs.send(event)

    def ask_to_stop(self) -> None:
        self.asked = True

    def kill(self) -> None:
        if not self.killed:
            self.theirs.close()
        self.killed = True

    def join(self) -> str:
        return "it was killed"


def _job(seed: int) -> SessionJob:
    progress = JobProgress((seed,), iterations=10, mode="greedy", iteration_steps=64)
    job = SimpleNamespace(progress=progress, take=progress.take, can_restart=lambda: False)
    return cast(SessionJob, job)


def _run(trainings: Sequence[_Silent | OSError], tick: Callable[[], Any]) -> list[str]:
    """Return the statuses in which jobs with these training processes end; an error: it cannot be started."""
    jobs, waiting = [_job(seed) for seed in range(len(trainings))], iter(trainings)

    def start(job: SessionJob) -> _Silent:
        if isinstance(training := next(waiting), OSError):
            raise training
        return training

    def ticked() -> Sequence[str]:
        tick()
        return ()

    started = Scheduler(jobs, CoreShares(len(jobs), 1), start, lambda job: None, ticked)
    started.run()
    return [job.progress.status for job in jobs]


@pytest.mark.slow
def test_a_training_process_that_does_not_stop_is_killed(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Another that stops in time is not."""
    monkeypatch.setattr(scheduler, "_STOP_S", 0.5)
    hanging, stopping = _Silent(), _Silent()

    def interrupt_once() -> None:
        if not hanging.asked:
            signal.raise_signal(signal.SIGINT)
        elif not stopping.theirs.closed:
            stopping.theirs.send(Finished(1, stopped=True))
            stopping.theirs.close()

    assert _run([hanging, stopping], interrupt_once) == ["stopped", "stopped"]
    assert (hanging.killed, stopping.killed) == (True, False)
    told = capsys.readouterr().err
    assert told.count("does not stop: killed; training after the last checkpoint is lost") == 1
    assert "seed 0 does not stop" in told


def test_a_training_process_that_cannot_be_started_fails_alone(capsys: pytest.CaptureFixture[str]) -> None:
    other = _Silent((*BEGUN, Finished(10, stopped=False)))
    other.theirs.close()
    refused = OSError(errno.EAGAIN, "Resource temporarily unavailable")
    assert _run([refused, other], lambda: None) == ["failed", "finished"]
    line = "seed 0 failed: its training process cannot be started (Resource temporarily unavailable); lower"
    assert line in capsys.readouterr().err


def test_a_training_process_that_has_not_begun_is_killed_at_once(capsys: pytest.CaptureFixture[str]) -> None:
    starting = _Silent([])

    def interrupt_once() -> None:
        if not starting.asked:
            signal.raise_signal(signal.SIGINT)

    assert _run([starting], interrupt_once) == ["stopped"]
    assert starting.killed
    assert "with a checkpoint" not in capsys.readouterr().err


def test_a_training_process_that_hangs_after_its_final_event_is_killed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """It may wait for ever for a worker that cannot end; its result has arrived."""
    monkeypatch.setattr(scheduler, "_END_S", 0.3)
    hanging = _Silent((*BEGUN, Finished(10, stopped=False)))
    assert _run([hanging], lambda: None) == ["finished"]
    assert hanging.killed


@pytest.mark.parametrize(
    ("lost", "is_asked", "status"),
    [(True, True, "stopped"), (True, False, "failed"), (False, True, "failed")],
)
def test_workers_lost_after_a_stop_request_are_no_failure(
    lost: bool, is_asked: bool, status: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """`scancel` ends the session's workers and their cluster together with the session."""
    training = _Silent()

    def fail() -> None:
        if is_asked and not training.asked:
            signal.raise_signal(signal.SIGTERM)
        elif not training.theirs.closed:
            training.theirs.send(Failed("no Ray cluster answers", "", lost))
            training.theirs.close()

    assert _run([training], fail) == [status]
    assert capsys.readouterr().err.count("no Ray cluster answers") == 1


@pytest.mark.slow
def test_a_silent_training_process_is_named_once(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """One that is starting is not: how long that takes is not known."""
    monkeypatch.setattr(scheduler, "_SILENT_S", 0.2)
    silent, starting = _Silent(), _Silent([])
    until = time.monotonic() + 1.5

    def end_all_later() -> None:
        if time.monotonic() > until:
            for training in (silent, starting):
                if not training.theirs.closed:
                    training.theirs.send(Finished(1, stopped=False))
                    training.theirs.close()

    assert _run([silent, starting], end_all_later) == ["finished", "finished"]
    told = capsys.readouterr().err
    assert told.count("it may hang: Ctrl-C stops it") == 1
    assert "seed 0 has been silent for " in told
