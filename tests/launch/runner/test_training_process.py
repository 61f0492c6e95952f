"""The session's handle of a training process, if that dies before it has read its work."""

import sys
from multiprocessing import get_context
from threading import Thread
from types import SimpleNamespace
from typing import NoReturn, cast

import pytest

from headway.contracts.errors import HeadwayError
from headway.events import Event, Failed
from headway.training import loop
from headway.training.loop import TrainingJob
from headway_launch.runner.training_process import TrainingProcess, train_and_report


@pytest.mark.parametrize(
    ("code", "line"),
    [
        ("raise SystemExit(3)", "its training process ended with exit code 3 and without a final event"),
        # A real-time signal, most of which have no name in Python.
        ("import os; os.kill(os.getpid(), 40)", "its training process was killed by signal 40"),
    ],
)
def test_a_process_killed_before_it_has_read_its_work_is_at_its_end(
    monkeypatch: pytest.MonkeyPatch, code: str, line: str
) -> None:
    """Its work, 1 MB here, is more than a pipe holds (64 KiB)."""
    monkeypatch.setattr("headway_launch.runner.training_process.get_context", get_context)  # a real start
    monkeypatch.setattr("multiprocessing.spawn.get_command_line", lambda **_: [sys.executable, "-c", code])
    received: list[object] = []

    def start() -> None:
        process = TrainingProcess(cast(TrainingJob, SimpleNamespace(seeds=(0,), ballast="x" * 2**20)))
        received.extend((process.receive(), process.join()))

    # In a thread, so that waiting for ever fails the test.
    thread = Thread(target=start, daemon=True)
    thread.start()
    thread.join(20)
    assert received == [None, line]


class _UnreadableError(Exception):
    def __str__(self) -> str:
        raise RuntimeError("no message")


@pytest.mark.parametrize(
    ("error", "line"),
    [
        (SystemExit(5), "SystemExit: 5"),
        (BaseException("all\nof it"), "BaseException: all"),
        (_UnreadableError(), "_UnreadableError: its message cannot be read"),
        (BrokenPipeError(32, "Broken pipe"), "BrokenPipeError: [Errno 32] Broken pipe"),
        (HeadwayError("set algo.lr"), "set algo.lr"),
    ],
)
def test_whatever_an_environment_raises_fails_the_run_in_one_line(
    monkeypatch: pytest.MonkeyPatch, error: BaseException, line: str
) -> None:
    def train(*_: object) -> NoReturn:
        raise error

    monkeypatch.setattr(loop, "train", train)
    events: list[Event] = []
    train_and_report(cast(TrainingJob, None), events.append, lambda: False)
    [failed] = events
    assert isinstance(failed, Failed)
    assert failed.line == line
    assert type(error).__name__ in failed.traceback
