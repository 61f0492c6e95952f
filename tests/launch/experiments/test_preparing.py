"""Training and evaluation environments are prepared together and share their data."""

import pickle
from typing import Any

import numpy as np
import pytest

from headway.wrappers.wrapped_env import Wrapped
from headway_envs.bus import prepare as preparation
from headway_envs.bus.config import BusConfig
from headway_envs.bus.prepare import prepare
from headway_envs.bus.prepared import Prepared
from headway_envs.bus.scenario.synthetic import generate_lines
from headway_envs.bus.scenario.tables import Columns
from headway_launch.experiments.compose import compose
from headway_launch.runner.jobs import PlannedJob, plan_jobs

BUS = ["env=bus", "preset=none", "algo=ippo", "seed=0..2"]
OWN = "env.training_args.reward.scope=own"
WRAPPERS = "env.wrappers=[{name: clip_reward_v0, lower_bound: -1, upper_bound: 1}]"


@pytest.fixture
def generated(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, int]]:
    """Calls (scenario, seed) of the scenario generator."""
    calls = []

    def counted(scenario: str, seed: int) -> dict[str, Columns]:
        calls.append((scenario, seed))
        return generate_lines(scenario, seed)

    monkeypatch.setattr(preparation, "generate_lines", counted)
    return calls


@pytest.mark.parametrize("others", [[], [OWN, WRAPPERS], [WRAPPERS]])
def test_a_scenario_is_generated_once(generated: list[tuple[str, int]], others: list[str]) -> None:
    jobs = plan_jobs(compose([*BUS, *others]))
    assert generated == [("line", 0)]
    for job in jobs:
        reported, learned = (_inner(each) for each in _prepared(job))
        assert reported.network is learned.network
        assert reported.config.reward.scope == "team"
        assert learned.config.reward.scope == ("own" if OWN in others else "team")
    # Sharing survives the pickling for a training process.
    prepared, training = pickle.loads(pickle.dumps(_prepared(jobs[0])))
    assert _inner(prepared).network.running is _inner(training).network.running


def test_other_training_arguments_prepare_a_second_environment(generated: list[tuple[str, int]]) -> None:
    job = plan_jobs(compose([*BUS, "env.training_args.capacity=50"]))[0]
    assert generated == [("line", 0)] * 2
    alone = prepare(BusConfig(capacity=50))
    _, training = _prepared(job)
    assert training.config == alone.config
    for shared, own in zip(training.network, alone.network, strict=True):
        assert np.array_equal(shared, own)


def _prepared(job: PlannedJob) -> tuple[Any, Any]:
    """Return the shared data of the job's evaluation and training environments."""
    return job.training.plan.prepared, job.training.plan.training_prepared


def _inner(prepared: object) -> Prepared:
    """Return the data of the environment inside any wrappers."""
    inner = prepared.prepared if isinstance(prepared, Wrapped) else prepared
    assert isinstance(inner, Prepared)
    return inner
