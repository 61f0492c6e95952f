"""Policies that remember: one seed, one curve, whatever the backend, the interruptions and the accidents."""

from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from rehearsal import (
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

from headway.contracts import StepResult, Trajectory
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


def test_worker_processes_change_nothing(whole: Log, tmp_path: Path) -> None:
    trained(job := job_of(tmp_path, backend="process", core="gru"))
    assert logs_of(job) == [whole]


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


def test_an_agents_memory_is_a_part_of_what_it_does(
    whole: Log, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The same network that forgets after every step does something else."""
    monkeypatch.setattr(PolicyPlayer, "heed", lambda acting, outcome: acting.forget())
    trained(job := job_of(tmp_path, core="gru"))
    assert logs_of(job) != [whole]


def _taken(plan: RolloutPlan, iterations: int = 3) -> list[Taken]:
    with collector_of(plan, "serial") as collector:
        collector.begin()
        return iterations_of(collector, parameters_of(plan), 1, iterations)


def test_memory_goes_on_between_iterations_and_ends_with_a_stream() -> None:
    """Three iterations of 20 steps are one of 60, where draws are the same."""
    short = _steadily(plan_of_toy("visitors", seeds=(5, 6), steps=20, core="gru"), 3)
    long = _steadily(plan_of_toy("visitors", seeds=(5, 6), steps=60, core="gru"), 1)[0]
    joined = np.concatenate([part.log_probs for part in short])
    alive = long.alive[:-1]
    np.testing.assert_array_equal(joined[alive], long.log_probs[alive])
    ended = (long.terminated | long.truncated)[[19, 39]]
    for row, part in zip(ended, short[1:], strict=True):
        np.testing.assert_array_equal(part.begins[0], row)
        assert not part.hidden_states[0][row].any()
        assert part.hidden_states[0].any()
    assert short[0].begins.all()
    assert not short[0].hidden_states.any()
    assert ended.any()


class _Steady(GRUActingPolicy):
    def noise(self, generator: np.random.Generator, steps: int) -> NDArray[np.float64]:
        return np.full((steps, self.flat.spec.num_agents), 0.5)


def _steadily(plan: RolloutPlan, iterations: int) -> list[Trajectory]:
    """Trajectories under noise that is the same in every iteration."""
    assert isinstance(plan.policy, GRUActingPolicy)
    plan = replace(plan, policy=_Steady(plan.policy.flat, plan.policy.hidden_size))
    with collector_of(plan, "serial") as collector:
        collector.begin()
        found = []
        for iteration in range(1, iterations + 1):
            collector.collect(iteration, parameters_of(plan))
            track = collector.trajectory
            found.append(Trajectory(*(getattr(track, field.name).copy() for field in fields(track))))
        return found


@pytest.mark.parametrize("block", [1, 2, 4])
def test_blocks_remember_each_its_own_copies(block: int) -> None:
    """Copies are dealt out to workers and blocks, and every one goes on from its own memory."""
    plan = plan_of_toy("visitors", seeds=(5, 6), block=block, core="gru")
    with collector_of(plan, workers=2) as collector:
        collector.begin()
        assert_same(_taken(plan), iterations_of(collector, parameters_of(plan), 1, 3))


def test_a_trajectory_has_no_room_for_memory_where_there_is_none() -> None:
    plain, remembering = (plan_of_toy("visitors", core=core) for core in ("none", "gru"))
    assert (hidden_size(plain.policy), hidden_size(remembering.policy)) == (0, 4)
    assert Trajectory.allocate(plain.layout).hidden_states.size == 0
    assert Trajectory.allocate(remembering.layout).hidden_states.shape == (1, 4, 3, 4)
    plain_acting, acting = (PolicyPlayer(plan, 4, 4) for plan in (plain, remembering))
    assert plain_acting.snapshot() == {}
    assert acting.snapshot().keys() == {"memory", "begins"}


def test_without_snapshots_all_is_forgotten_with_the_episodes(tmp_path: Path) -> None:
    """A worker that was killed begins anew, memory and all, and says so to the learner."""
    config = FaultConfig("kill", str(tmp_path), at=30, copies=2, snapshots=False)
    plan = plan_of(FaultyVisitors, config, core="gru")
    with collector_of(plan, workers=2) as collector:
        collector.begin()
        taken = iterations_of(collector, parameters_of(plan), 1, 2)
    begins, memory = taken[1].arrays["begins"][0], taken[1].arrays["hidden_states"][0]
    anew = begins.all(axis=1)
    assert 0 < anew.sum() <= 3
    assert not memory[begins].any()
    assert memory[~anew].any()


def test_who_is_terminated_or_truncated_forgets_and_no_one_else() -> None:
    plan = plan_of_toy("visitors", core="gru")
    acting = PolicyPlayer(plan, 2, 2)
    assert acting.memory is not None
    acting.memory.fill(1)
    over, none = np.zeros((2, 3), np.bool_), np.zeros((2, 0))
    over[1, 1:] = True
    acting.heed(
        StepResult(
            rewards=none,
            terminated=over,
            truncated=over[::-1],
            acting=over,
            episode_ended=over[:, 0],
            final_observations=none,
            final_states=none,
            metrics=none,
        )
    )
    assert (acting.memory == 0).all(axis=2).tolist() == (over | over[::-1]).tolist()
