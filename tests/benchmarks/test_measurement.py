"""Measured trainings equal those of `headway run`."""

import pytest

import headway.training.loop
from benchmarks.measurement import Task, measure_here
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
