"""Sessions whose output is not read, and training processes that die in the middle of an event."""

import os
import subprocess
import sys
from multiprocessing import get_context
from pathlib import Path

import pytest
from small_runs import SMALL

from headway.config.experiment import StoreConfig
from headway.events import Failed
from headway.store.index import RunIndex
from headway.store.session import Cell, SessionStore
from headway_launch.runner.recorder import TRACEBACK, JobRecorder
from headway_launch.runner.training_process import TrainingProcess

TINY = ("env=trivial", "algo=ippo", *SMALL, "backend=serial", "env_steps=256")


def _unheard(*arguments: str, folder: Path) -> int:
    """Exit code of a `headway` whose output is not read."""
    ours, its = os.pipe()
    os.close(ours)
    command = [sys.executable, "-m", "headway_launch", *arguments]
    done = subprocess.run(command, cwd=folder, stdout=its, stderr=its, timeout=120, check=False)
    os.close(its)
    return done.returncode


@pytest.mark.slow
def test_a_session_without_listeners_trains_to_its_end(tmp_path: Path) -> None:
    assert _unheard("run", *TINY, "evaluation.rules=[optimal]", folder=tmp_path) == 0
    assert [row.status for row in RunIndex(tmp_path / "runs").rows()] == ["FINISHED"]
    assert _unheard("run", *TINY, "algo.lrr=1", folder=tmp_path) == 2


@pytest.mark.parametrize("word", [b"", b"\x00", (100).to_bytes(4, "big") + b"the beginning"])
def test_a_process_killed_in_the_middle_of_an_event_is_at_its_end(word: bytes) -> None:
    ours, its = get_context("spawn").Pipe()
    process = object.__new__(TrainingProcess)
    process._events, process._at_end = ours, False
    os.write(its.fileno(), word)
    its.close()
    assert process.receive() is None
    assert not process.has_event()
    assert process.has_ended()
    ours.close()


def test_a_store_that_cannot_keep_a_traceback_does_not_end_the_other_jobs(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    store = SessionStore(StoreConfig(root=str(tmp_path)))
    run = Cell(store, "study", "trivial", "ippo", {}).begin_run(0, "seed: 0\n", {}, iterations=1)
    (run.directory / TRACEBACK).mkdir()
    recording = JobRecorder([run])
    recording.take(Failed("it broke", "Traceback"))
    assert recording.failure is not None
    assert "traceback.txt" in capsys.readouterr().err
    store.close()
