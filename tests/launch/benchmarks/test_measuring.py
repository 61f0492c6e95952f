"""What is measured is the training that `headway run` would do."""

import pytest

import headway.training
from headway.config import BackendConfig
from headway.rollout.collecting import Contributors
from headway.rollout.contributing import AsynchronousPlan
from headway.rollout.crew import Notify
from headway_launch.benchmarks.measuring import Task, measure_here


def test_asynchronous_algorithms_are_measured_with_their_workers(monkeypatch: pytest.MonkeyPatch) -> None:
    opened: list[Contributors] = []
    open_contributors = headway.training.open_contributors

    def opening(backend: BackendConfig, plan: AsynchronousPlan, notify: Notify) -> Contributors:
        opened.append(open_contributors(backend, plan, notify))
        return opened[-1]

    monkeypatch.setattr(headway.training, "open_contributors", opening)
    task = Task("trivial", "a3c", {}, {}, copies=4, steps=8, block=2, iterations=4)
    assert measure_here(task).env_steps == 2 * 4 * 8
    (contributors,) = opened
    assert contributors.number == 2
