"""Measured trainings equal those of `headway run`."""

import os
import subprocess
import sys

import psutil
import pytest

import headway.training.loop
from benchmarks import measurement
from benchmarks.measurement import Task, _peak_mb, measure_here
from headway.config.experiment import BackendConfig
from headway.rollout.collector import Contributors
from headway.rollout.plan import RolloutPlan
from headway.rollout.workers.worker_pool import Notify

SIZES = ("backend=serial", "rollout.copies=4", "rollout.steps=8", "rollout.block=2")


def test_asynchronous_algorithms_are_measured_with_their_workers(monkeypatch: pytest.MonkeyPatch) -> None:
    opened: list[Contributors] = []
    open_contributors = headway.training.loop.open_contributors

    def opening(backend: BackendConfig, plan: RolloutPlan, notify: Notify) -> Contributors:
        opened.append(open_contributors(backend, plan, notify))
        return opened[-1]

    monkeypatch.setattr(headway.training.loop, "open_contributors", opening)
    task = Task(("env=trivial", "algo=a3c", *SIZES), 2 * 4 * 8)
    assert measure_here(task).env_steps == 2 * 4 * 8
    (contributors,) = opened
    assert contributors.number == 2


def test_memory_is_that_of_workers(monkeypatch: pytest.MonkeyPatch) -> None:
    """It is 0 for a training in one process."""
    task = Task(("env=trivial", "algo=ippo", *SIZES), 2 * 4 * 8)
    assert measure_here(task).worker_mb == 0
    asked: list[int] = []

    def peak_mb(process_id: int) -> float:
        asked.append(process_id)
        return _peak_mb(process_id)

    monkeypatch.setattr(measurement, "_peak_mb", peak_mb)
    found = measure_here(task.having("backend=process", "backend.workers=2")).worker_mb
    assert 5 < found < 2000
    assert len(set(asked)) == 2
    assert os.getpid() not in asked


def test_the_peak_memory_of_an_ended_process_is_zero() -> None:
    assert _peak_mb(os.getpid()) >= psutil.Process().memory_info().rss / 2**20 * 0.5
    child = subprocess.Popen([sys.executable, "-c", ""])
    child.wait()
    assert _peak_mb(child.pid) == 0
