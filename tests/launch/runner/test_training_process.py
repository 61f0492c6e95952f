"""The session's handle of a training process, if that dies before it has read its work."""

import sys
from functools import partial
from multiprocessing import get_context
from threading import Thread
from types import SimpleNamespace
from typing import cast

import pytest

from headway.training.loop import TrainingJob
from headway_launch.runner.training_process import TrainingProcess


def test_a_process_killed_before_it_has_read_its_work_is_at_its_end(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its work, 1 MB here, is more than a pipe holds (64 KiB)."""
    monkeypatch.setattr("headway_launch.runner.training_process.get_context", get_context)  # a real start
    monkeypatch.setattr(
        "multiprocessing.spawn.get_command_line", lambda **_: [sys.executable, "-c", "raise SystemExit(3)"]
    )
    received: list[object] = []

    def start() -> None:
        job = cast(TrainingJob, SimpleNamespace(seeds=(0,)))
        process = TrainingProcess(job, partial(print, "x" * 2**20))
        received.extend((process.receive(), process.join()))

    # In a thread, so that waiting for ever fails the test.
    thread = Thread(target=start, daemon=True)
    thread.start()
    thread.join(20)
    assert received == [None, "its training process ended with exit code 3 and without a final event"]
