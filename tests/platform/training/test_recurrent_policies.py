"""Recurrent policies: one seed gives one curve, whatever the backend, interruptions and failures."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from rehearsal import (
    Arrays,
    FaultConfig,
    FaultyVisitors,
    Taken,
    assert_same,
    collector_of,
    iterations_of,
    parameters_of,
    plan_of,
    plan_of_toy,
)
from runs import Log, job_of, logs_of, trained

from headway.contracts import Trajectory
from headway.contracts.acting_policy import hidden_size
from headway.rollout.plan import RolloutPlan
from headway.rollout.policy_player import PolicyPlayer
from headway_algos.acting.gru import GRUActingPolicy


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Log:
    """Six iterations of seed 5 on visitors, undisturbed, on the serial backend."""
    job = job_of(tmp_path_factory.mktemp("whole"), core="gru")
    trained(job)
    return logs_of(job)[0]


def test_a_killed_worker_changes_nothing(whole: Log, tmp_path: Path) -> None:
    env = FaultyVisitors, FaultConfig("kill", str(tmp_path), at=41, copies=2)
    trained(job := job_of(tmp_path, env, backend="process", core="gru"))
    assert (tmp_path / "struck-0").exists()
    assert logs_of(job) == [whole]


def test_a_run_stopped_and_resumed_changes_nothing(whole: Log, tmp_path: Path) -> None:
    job = job_of(tmp_path, core="gru")
    trained(job, stop_after=3)
    trained(replace(job, resume=True))
    assert logs_of(job) == [whole]


def test_actions_depend_on_hidden_states(whole: Log, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The same network gives another curve if its hidden states are reset after every step."""
    monkeypatch.setattr(PolicyPlayer, "reset_ended", lambda player, outcome: player.reset())
    trained(job := job_of(tmp_path, core="gru"))
    assert logs_of(job) != [whole]


def _taken(plan: RolloutPlan, iterations: int = 3) -> list[Taken]:
    with collector_of(plan, "serial") as collector:
        collector.begin()
        return iterations_of(collector, parameters_of(plan), 1, iterations)


def test_hidden_states_continue_between_iterations_and_end_with_a_stream() -> None:
    """Three iterations of 20 steps equal one of 60 if the noise is the same."""
    short = _steadily(plan_of_toy("visitors", seeds=(5, 6), steps=20, core="gru"), 3)
    long = _steadily(plan_of_toy("visitors", seeds=(5, 6), steps=60, core="gru"), 1)[0]
    joined = np.concatenate([part["log_probs"] for part in short])
    alive = long["alive"][:-1]
    np.testing.assert_array_equal(joined[alive], long["log_probs"][alive])
    ended = (long["terminated"] | long["truncated"])[[19, 39]]
    for row, part in zip(ended, short[1:], strict=True):
        np.testing.assert_array_equal(part["begins"][0], row)
        np.testing.assert_array_equal(part["episode_begins"][0], row.all(axis=1))
        assert not part["hidden_states"][0][row].any()
        assert part["hidden_states"][0].any()
    assert short[0]["begins"].all()
    assert not short[0]["hidden_states"].any()
    assert ended.any()


class _Steady(GRUActingPolicy):
    def noise(self, generator: np.random.Generator, steps: int) -> NDArray[np.float64]:
        return np.full((steps, self.perceptron.spec.num_agents), 0.5)


def _steadily(plan: RolloutPlan, iterations: int) -> list[Arrays]:
    """Trajectories with the same noise in every iteration."""
    assert isinstance(plan.policy, GRUActingPolicy)
    plan = replace(plan, policy=_Steady(plan.policy.perceptron, plan.policy.hidden_size))
    return [taken.arrays for taken in _taken(plan, iterations)]


@pytest.mark.parametrize("block", [1, 2, 4])
def test_every_copy_keeps_its_hidden_states_in_any_block(block: int) -> None:
    """Copies are divided among workers and blocks, and each continues from its own hidden states."""
    plan = plan_of_toy("visitors", seeds=(5, 6), block=block, core="gru")
    with collector_of(plan, workers=2) as collector:
        collector.begin()
        assert_same(_taken(plan), iterations_of(collector, parameters_of(plan), 1, 3))


def test_a_policy_without_recurrence_has_no_hidden_states() -> None:
    plain, recurrent = (plan_of_toy("visitors", core=core) for core in ("none", "gru"))
    assert (hidden_size(plain.policy), hidden_size(recurrent.policy)) == (0, 4)
    assert Trajectory.allocate(plain.layout).hidden_states.size == 0
    assert Trajectory.allocate(recurrent.layout).hidden_states.shape == (1, 4, 3, 4)
    plain_player, recurrent_player = (PolicyPlayer(plan, 4, 4) for plan in (plain, recurrent))
    assert plain_player.snapshot() == {}
    assert recurrent_player.snapshot().keys() == {"memory", "begins"}


def test_without_snapshots_hidden_states_are_reset_with_the_episodes(tmp_path: Path) -> None:
    """The replacement of a killed worker starts with empty hidden states and marks streams as beginning."""
    config = FaultConfig("kill", str(tmp_path), at=30, copies=2, snapshots=False)
    plan = plan_of(FaultyVisitors, config, core="gru")
    with collector_of(plan, workers=2) as collector:
        collector.begin()
        taken = iterations_of(collector, parameters_of(plan), 1, 2)
    begins, hidden_states = taken[1].arrays["begins"][0], taken[1].arrays["hidden_states"][0]
    restarted = taken[1].arrays["episode_begins"][0]
    assert 0 < restarted.sum() <= 3
    assert begins[restarted].all()
    assert not hidden_states[begins].any()
    assert hidden_states[~restarted].any()


def test_hidden_states_are_reset_exactly_where_terminated_or_truncated() -> None:
    plan = plan_of_toy("visitors", core="gru")
    player = PolicyPlayer(plan, 2, 2)
    assert player.hidden_states is not None
    player.hidden_states.fill(1)
    over = np.zeros((2, 3), np.bool_)
    over[1, 1:] = True
    ends: Any = SimpleNamespace(terminated=over, truncated=over[::-1])
    player.reset_ended(ends)
    assert (player.hidden_states == 0).all(axis=2).tolist() == (over | over[::-1]).tolist()
