"""One copy per process, end to end: workers, separate evaluation, replacement of a killed SUMO.

That learners ignore empty slots is tested in `tests/algos`."""

import os
import signal
from collections.abc import Iterator
from contextlib import closing, contextmanager
from copy import deepcopy
from dataclasses import fields
from typing import Any

import numpy as np

from headway.config.experiment import BackendConfig
from headway.config.schema import build
from headway.contracts import Trajectory
from headway.rollout.backends import open_collector
from headway.rollout.collector import Collector
from headway.rollout.plan import RolloutPlan
from headway_algos.registry import ENTRIES as ALGORITHMS
from headway_algos.registry import configure
from headway_envs.intersection.config import IntersectionConfig
from headway_envs.intersection.entry import ENTRY

SHARED = configure("custom", policies="shared", critic="local")


def _plan(copies: int) -> RolloutPlan:
    prepared = ENTRY.prepare(IntersectionConfig(horizon=100, slots=24))
    with closing(ENTRY.make(prepared, 1)) as env:
        spec = env.spec
    policy = ALGORITHMS["ippo"].acting_policy(SHARED, spec)
    return RolloutPlan(ENTRY.make, ENTRY.preload, prepared, spec, policy, (5,), copies, 60, 1)


def _parameters(plan: RolloutPlan) -> dict[str, Any]:
    learner = ALGORITHMS["ippo"].learner(SHARED, plan.spec, plan.seeds, "cpu")
    return learner.acting_parameters()


@contextmanager
def _collector(plan: RolloutPlan, name: str, notices: list[str] | None = None) -> Iterator[Collector]:
    said = [] if notices is None else notices
    with closing(
        open_collector(build(BackendConfig, {"name": name}), plan, plan.replicas * plan.copies, said.append)
    ) as collector:
        yield collector


def test_backends_are_equal_and_evaluation_does_not_affect_training() -> None:
    plan, given = _plan(copies=1), []
    parameters = _parameters(plan)
    for name in ("serial", "process"):
        with _collector(plan, name) as collector:
            assert len(collector.process_ids()) == {"serial": 1, "process": 2}[name]
            collector.begin()
            collector.collect(1, parameters)
            evaluated = collector.evaluate(7, 2, False, parameters)
            episodes = collector.collect(2, parameters)
            given.append((deepcopy(collector.trajectory), evaluated, episodes))
    one, other = given
    assert one[1:] == other[1:]
    assert len(one[2]) == 1
    assert one[0].alive.any()
    for field in fields(Trajectory):
        np.testing.assert_array_equal(getattr(one[0], field.name), getattr(other[0], field.name), field.name)


def test_a_killed_simulation_is_replaced_and_the_run_goes_on() -> None:
    plan, notices = _plan(copies=2), []
    parameters = _parameters(plan)
    with _collector(plan, "process", notices) as collector:
        collector.begin()
        collector.collect(1, parameters)
        training, evaluating = collector.process_ids()[0], collector.process_ids()[-1]
        for victim in (training, evaluating):
            os.kill(victim, signal.SIGKILL)
        collector.collect(2, parameters)
        assert notices == ["worker 0 failed (killed by signal 9); replaced, its episodes start again"]
        assert len(collector.evaluate(7, 1, True, parameters)[0]) == 1
        collector.collect(3, parameters)
        assert training not in collector.process_ids()
        assert evaluating not in collector.process_ids()
        assert np.isfinite(collector.trajectory.rewards).all()
