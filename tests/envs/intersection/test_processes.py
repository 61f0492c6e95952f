"""One copy per process, end to end: workers, separate evaluation, replacement of a killed SUMO."""

import os
import signal
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import fields, replace
from typing import Any, Literal

import numpy as np
import pytest
from covering import quick_or_slow

from headway.config.experiment import BackendConfig
from headway.config.schema import build
from headway.contracts import Trajectory
from headway.registry import algo_entries
from headway.rollout.backends import open_collector
from headway.rollout.collector import Collector
from headway.rollout.plan import RolloutPlan
from headway_algos.on_policy.learner import OnPolicyLearner
from headway_algos.registry import ENTRIES as ALGORITHMS
from headway_algos.registry import configure
from headway_envs.intersection.config import IntersectionConfig, RewardConfig
from headway_envs.intersection.entry import ENTRY

SHARED = configure("custom", policies="shared", critic="local")


SHORT = IntersectionConfig(horizon=100, slots=24)


def _plan(
    copies: int, steps: int = 60, seeds: Sequence[int] = (5,), config: IntersectionConfig = SHORT
) -> RolloutPlan:
    prepared = ENTRY.prepare(config)
    with closing(ENTRY.make(prepared, 1)) as env:
        spec = env.spec
    policy = ALGORITHMS["ippo"].acting_policy(SHARED, spec)
    return RolloutPlan(ENTRY.make, ENTRY.preload, prepared, spec, policy, tuple(seeds), copies, steps, 1)


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


def _copied(trajectory: Trajectory) -> Trajectory:
    return Trajectory(*(getattr(trajectory, field.name).copy() for field in fields(trajectory)))


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
            given.append((_copied(collector.trajectory), evaluated, episodes))
    one, other = given
    assert one[1:] == other[1:]
    assert len(one[2]) == 1
    assert one[0].alive.any()
    for field in fields(Trajectory):
        np.testing.assert_array_equal(getattr(one[0], field.name), getattr(other[0], field.name), field.name)


def test_stacked_seeds_have_own_processes_and_equal_single_seeds() -> None:
    stacked = _plan(copies=1, seeds=(5, 6))
    parameters = _parameters(stacked)
    with _collector(stacked, "process") as collector:
        collector.begin()
        collector.collect(1, parameters)
        episodes = collector.collect(2, parameters)
        together = _copied(collector.trajectory)
        evaluated = collector.evaluate(7, 2, False, parameters)
    assert not np.array_equal(together.alive[:, 0], together.alive[:, 1])
    for replica, seed in enumerate(stacked.seeds):
        alone = _plan(copies=1, seeds=(seed,))
        own = stacked.parameters_of(parameters, replica, 1)
        with _collector(alone, "process") as collector:
            collector.begin()
            collector.collect(1, own)
            expected = [(replica, episode.row) for episode in collector.collect(2, own)]
            assert [(e.replica, e.row) for e in episodes if e.replica == replica] == expected
            for field in fields(Trajectory):
                ours = getattr(together.of_copies(replica, 1), field.name)
                np.testing.assert_array_equal(ours, getattr(collector.trajectory, field.name), field.name)
            assert collector.evaluate(7, 2, False, own) == [evaluated[replica]]


def test_a_killed_simulation_is_replaced_and_the_run_goes_on() -> None:
    plan, notices = _plan(copies=2, steps=60), []
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


@pytest.fixture(scope="module")
def experience() -> dict[str, tuple[RolloutPlan, Trajectory]]:
    """Trajectories of 500 steps in which vehicles enter, crash and leave, by kind of reward."""
    made = {}
    for kind in ("scaled", "paper"):
        config = IntersectionConfig(horizon=420, slots=24, av_speed_mode=0, reward=RewardConfig(kind=kind))
        plan = _plan(copies=1, steps=500, config=config)
        with _collector(plan, "serial") as collector:
            collector.begin()
            parameters = _parameters(plan)
            last = max(name for name in parameters if name.endswith("bias") or "bias" in name)
            parameters[last] = parameters[last] + 2.0  # full throttle
            collector.collect(1, parameters)
            made[kind] = plan, _copied(collector.trajectory)
    return made


def _poisoned(clean: Trajectory) -> Trajectory:
    bad = _copied(clean)
    over = bad.terminated | bad.truncated
    bad.observations[~bad.alive] = np.nan
    bad.actions[~bad.alive[:-1]] = np.nan
    bad.log_probs[~bad.acting] = np.nan
    bad.final_observations[~over] = np.nan
    bad.final_states[~over.all(axis=-1)] = np.nan
    return bad


@pytest.mark.parametrize(
    ("algorithm", "kind"),
    quick_or_slow(
        {
            f"{algorithm}-{kind}": (algorithm, kind)
            for kind in ("scaled", "paper")
            for algorithm in sorted(set(algo_entries()) - {"coma", "happo", "hatrpo", "madqn"})
        },
        "ippo-scaled",
        "maacktr-paper",
        "ddpg-scaled",
    ),
)
def test_nothing_is_learned_from_empty_slots(
    algorithm: str, kind: str, experience: dict[str, tuple[RolloutPlan, Trajectory]]
) -> None:
    plan, clean = experience[kind]
    entry = algo_entries()[algorithm]
    keys = {field.name for field in fields(entry.config)}
    epochs = 2 if entry.contributor is None else 1
    wanted = {
        "name": algorithm,
        "policies": "shared",
        "model": {"hidden": [8]},
        "epochs": epochs,
        "updates": 9,
    }
    config = build(entry.config, {key: value for key, value in wanted.items() if key in keys})
    learned = []
    for trajectory in (clean, _poisoned(clean)):
        learner = entry.learner(config, plan.spec, plan.seeds, "cpu")
        learner.update(trajectory, 1, 0.0)
        learned.append({name: array.copy() for name, array in learner.acting_parameters().items()})
    for name, array in learned[0].items():
        np.testing.assert_array_equal(array, learned[1][name], name)
        assert np.isfinite(array).all()


def _moved(trajectory: Trajectory, slot: int, other: int, after: int) -> Trajectory:
    """Return the trajectory with the slots `slot` and `other` exchanged after a step."""
    moved = _copied(trajectory)
    for field in fields(Trajectory):
        array = getattr(moved, field.name)
        if array.ndim >= 3 and array.shape[2] == trajectory.alive.shape[2]:
            array[after + 1 :, :, [slot, other]] = array[after + 1 :, :, [other, slot]]
    return moved


@pytest.mark.parametrize("critic", ["local", "central"])
def test_the_previous_holder_of_a_slot_does_not_matter(
    critic: Literal["local", "central"],
    experience: dict[str, tuple[RolloutPlan, Trajectory]],
) -> None:
    """Two consecutive vehicles in one slot have the advantages that they would have in two slots."""
    plan, seen = experience["paper"]
    over = (seen.terminated | seen.truncated)[:, 0]
    ended = over.all(axis=1)
    places = [
        (step, slot, other)
        for step, slot in np.argwhere(over & ~ended[:, None]).tolist()
        for other in range(plan.spec.num_agents)
        # The other slot is empty while the first vehicle leaves this one and the second enters.
        if not seen.alive[: step + 2, 0, other].any() and seen.alive[step + 2 : step + 120, 0, slot].any()
    ]
    assert places
    step, slot, other = places[0]
    learner = OnPolicyLearner(replace(SHARED, critic=critic), plan.spec, plan.seeds, "cpu")
    given = [
        learner.critic.estimate(trajectory, learner.behaviour, 1).advantages[:, 0]
        for trajectory in (seen, _moved(seen, slot, other, step))
    ]
    np.testing.assert_allclose(given[0][: step + 1], given[1][: step + 1], rtol=0, atol=1e-9)
    rest = np.delete(np.arange(plan.spec.num_agents), [slot, other])
    np.testing.assert_allclose(given[0][step + 1 :, rest], given[1][step + 1 :, rest], rtol=0, atol=1e-9)
    np.testing.assert_allclose(given[0][step + 1 :, slot], given[1][step + 1 :, other], rtol=0, atol=1e-9)
    assert np.abs(given[0][step + 1 :, slot]).max() > 0
