"""Every registered algorithm trains on every registered environment, or refuses it in one line."""

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from functools import cache
from itertools import product
from typing import Any

import numpy as np
import pytest
from covering import pairwise
from dials import ENTRY as DIALS
from gpu import needs_gpu
from learned import assert_close, assert_equal, reloaded, tensors
from numpy.typing import NDArray
from toy_training import opened

from headway.config.schema import build
from headway.contracts import (
    AlgoEntry,
    Box,
    Discrete,
    EnvEntry,
    EnvSpec,
    HeadwayError,
    MultiDiscrete,
    Trajectory,
)
from headway.registry import algo_entries, algo_entry, env_entries, env_entry
from headway.rollout.async_collector import SerialContributors
from headway.rollout.collector import Backend
from headway.rollout.plan import RolloutPlan
from headway.rollout.serial_collector import SerialCollector

pytestmark = pytest.mark.slow

ITERATIONS, SEEDS, COPIES = 2, (3, 8), 2
POLICIES = ("independent", "shared", "groups")
SMALL: Mapping[str, Any] = {
    "model": {"hidden": [8]}, "epochs": 2, "minibatches": 2, "kl_bound": 0.1,
    "learning_starts": 1, "batch_size": 8, "updates": 3,
}  # fmt: skip
"""Settings for every algorithm that has these keys."""
ONE_GRADIENT = {"epochs": 1, "minibatches": 1}
"""Settings of asynchronous algorithms, whose workers compute one gradient per rollout."""


@dataclass(frozen=True)
class Task:
    """A small environment."""

    env: str
    arguments: Mapping[str, Any] = field(default_factory=dict)
    steps: int = 12
    """T: longer than an episode of the toys, so that trajectories contain episode ends."""
    seeds: tuple[int, ...] = SEEDS
    copies: int = COPIES
    groups: int = 0
    """Groups of agents that the environment names."""
    space: type[Discrete | MultiDiscrete | Box] = Discrete
    """Kind of the action space."""


RECURRENT = {"model": {"hidden": [8], "core": "gru", "gru_size": 4, "sequence_length": 5}}
REPLAYING = [name for name in algo_entries() if not hasattr(algo_entry(name).config().model, "core")]
"""Algorithms that replay single transitions, without recurrent networks."""
WITH_CORES = [name for name in algo_entries() if name not in (*REPLAYING, "maacktr")]
CORES: Mapping[str, Mapping[str, Any]] = {"none": {}, "gru": RECURRENT}
SPREAD = {"N": 2, "max_cycles": 8}
TASKS = {
    **{name: Task(name) for name in env_entries()},
    "bus": Task("bus", steps=30, groups=1),  # the first buses have left the depot and reached stops
    "bus_published": Task("bus_published", {"scenario": "line"}),
    # The first automated vehicles enter within 100 steps; a process holds one copy.
    "intersection": Task("intersection", {"slots": 5, "horizon": 100}, 110, seeds=(3,), copies=1, space=Box),
    "junctions": Task("junctions", {"slots": 20, "horizon": 40}, 30, seeds=(3,), copies=1),
    "tracking": Task("tracking", {"steps": 8}, space=Box),
    "trivial": Task("trivial", {"agents": 3, "steps": 8}),
    "dials": Task("dials", space=MultiDiscrete),
    "spread": Task("mpe2.simple_spread_v3", SPREAD),
    "spread, Box": Task("mpe2.simple_spread_v3", {**SPREAD, "continuous_actions": True}, space=Box),
}


@dataclass(frozen=True)
class Prepared:
    """The prepared environment of a task."""

    entry: EnvEntry
    shared: Any
    spec: EnvSpec


@cache
def prepared(task: str) -> Prepared:
    if task in ("intersection", "junctions"):
        pytest.importorskip("libsumo", reason="SUMO (headway[sumo]) is not installed")
    entry = DIALS if task == "dials" else env_entry(TASKS[task].env)
    shared = entry.prepare(build(entry.config, TASKS[task].arguments))
    env = entry.make(shared, 1)
    env.close()
    return Prepared(entry, shared, env.spec)


def configured(algorithm: str, policies: str, **more: Any) -> Any:  # noqa: ANN401 - the entry's record
    record = algo_entry(algorithm).config
    keys = {field.name for field in fields(record)}
    contributing = ONE_GRADIENT if algo_entry(algorithm).contributor is not None else {}
    wanted = {**SMALL, **contributing, "name": algorithm, "policies": policies, **more}
    return build(record, {key: value for key, value in wanted.items() if key in keys})


def refused(algorithm: str, policies: str, task: str) -> bool:
    """Return whether an algorithm must refuse a task: the table of refusals, stated independently."""
    space, groups = TASKS[task].space, TASKS[task].groups
    return (
        (algorithm in ("coma", "madqn") and space is not Discrete)
        or (algorithm == "ddpg" and space is not Box)
        or (algorithm in ("happo", "hatrpo") and policies == "shared")
        or (algorithm in ("happo", "hatrpo") and policies == "groups" and groups <= 1)
    )


def trainable(task: str, algorithm: str, policies: str, core: str) -> bool:
    recurrent = task in ("visitors", "tracking", "dials") and algorithm in WITH_CORES and policies != "groups"
    return not refused(algorithm, policies, task) and (core == "none" or recurrent)


def policy_of_agents(policies: str, spec: EnvSpec) -> NDArray[np.int64]:
    """Return the policy of each agent, (N,), as an index of K policies."""
    if policies == "groups" and spec.groups:
        return np.unique(spec.groups, return_inverse=True)[1]
    return np.arange(spec.num_agents) * (policies == "independent")


@dataclass(frozen=True)
class Trained:
    """Parameters of R seeds before and after some iterations."""

    before: Mapping[str, NDArray[Any]]
    after: Mapping[str, NDArray[Any]]
    metrics: Mapping[str, NDArray[np.float64]]
    """Metrics of the last iteration."""
    acted: NDArray[np.bool_]
    """(R, N): the agent used an action."""
    state: Mapping[str, Any]
    """The learner's state."""

    @property
    def moved(self) -> NDArray[np.bool_]:
        """Whether the networks of each policy changed, (P,). Normalisers and the exploration schedule do not
        count."""
        names = [name for name in self.before if not name.startswith(("observation_", "exploration"))]
        moves = [self.before[name] != self.after[name] for name in names]
        return np.any([move.reshape(len(move), -1).any(axis=1) for move in moves], axis=0)


def trajectories(backend: Backend) -> list[Trajectory]:
    if isinstance(backend, SerialContributors):
        return [worker.trajectory for worker in backend.workers]
    assert isinstance(backend, SerialCollector)
    return [backend.trajectory]


def trained(task: str, entry: AlgoEntry, config: object, device: str = "cpu") -> Trained:
    found, steps, seeds, copies = prepared(task), TASKS[task].steps, seeds_of(task, entry), TASKS[task].copies
    spec = found.spec.for_policies
    policy, block = entry.acting_policy(config, spec), copies if entry.contributor is None else 1
    plan = RolloutPlan(found.entry.make, (), found.shared, spec, policy, seeds, copies, steps, block)
    learner, backend, mode = opened(plan, entry, config, device)
    backend.begin()
    before = {name: array.copy() for name, array in learner.acting_parameters().items()}
    acted = np.zeros((len(seeds), found.spec.num_agents), dtype=np.bool_)
    for iteration in range(ITERATIONS):
        metrics = mode.iterate(iteration + 1, iteration / ITERATIONS).metrics
        for trajectory in trajectories(backend):
            by_copy = trajectory.acting.any(axis=0)
            acted |= by_copy.reshape(len(seeds), -1, found.spec.num_agents).any(axis=1)
    backend.close()
    return Trained(before, learner.acting_parameters(), metrics, acted, learner.state_dict())


def seeds_of(task: str, entry: AlgoEntry) -> tuple[int, ...]:
    """Asynchronous algorithms train one seed per process."""
    return TASKS[task].seeds if entry.contributor is None else TASKS[task].seeds[:1]


@pytest.mark.parametrize("task", TASKS)
def test_what_cannot_train_says_why_not(task: str) -> None:
    """Every algorithm with each way to share policies."""
    spec = prepared(task).spec
    assert (type(spec.action_space), len(set(spec.groups))) == (TASKS[task].space, TASKS[task].groups)
    for algorithm, policies, core in product(algo_entries(), POLICIES, CORES):
        if core == "gru" and algorithm not in WITH_CORES:
            continue
        reason = algo_entry(algorithm).refuses(configured(algorithm, policies, **CORES[core]), spec)
        assert (reason is not None) == refused(algorithm, policies, task), reason
        if reason is not None:
            assert "\n" not in reason
            assert reason.startswith(f"{algorithm} ")


@pytest.mark.parametrize(
    ("task", "algorithm", "policies", "core"),
    pairwise(TASKS, algo_entries(), POLICIES, CORES, where=trainable),
)
def test_what_is_not_refused_trains(task: str, algorithm: str, policies: str, core: str) -> None:
    config = configured(algorithm, policies, **CORES[core])
    assert_trains(task, algo_entry(algorithm), config, policies)


def assert_trains(task: str, entry: AlgoEntry, config: object, policies: str) -> None:
    """Check that every policy whose agents acted has changed. A trust region may keep some, but not all; off
    policy, a decision is learned from only after the agent's next one, which not every bus reaches here."""
    spec, seeds = prepared(task).spec, seeds_of(task, entry)
    result = trained(task, entry, config)
    assert all(np.isfinite(array).all() for array in result.after.values())
    assert all(value.shape == (len(seeds),) for value in result.metrics.values())
    assert all(np.isfinite(value).all() for value in result.metrics.values())
    moved, own = result.moved.reshape(len(seeds), -1), policy_of_agents(policies, spec)
    assert result.acted.any(axis=1).all()
    if getattr(config, "update", "") == "trpo" or (task == "bus" and hasattr(config, "capacity")):
        assert moved.any(axis=1).all()
    else:
        assert moved[:, own][result.acted].all()


@needs_gpu
@pytest.mark.parametrize(
    ("task", "algorithm", "policies", "core"),
    pairwise(("visitors", "tracking", "dials", "trivial"), algo_entries(), POLICIES, CORES, where=trainable),
)
def test_a_gpu_learns_what_a_cpu_learns(task: str, algorithm: str, policies: str, core: str) -> None:
    config = configured(algorithm, policies, precision="float64", **CORES[core])
    on_cpu, on_gpu = (trained(task, algo_entry(algorithm), config, device) for device in ("cpu", "cuda"))
    assert_close(dict(on_gpu.after), dict(on_cpu.after), rtol=1e-5, atol=1e-7)
    assert_close(dict(on_gpu.metrics), dict(on_cpu.metrics), rtol=1e-5, atol=1e-7)


@needs_gpu
@pytest.mark.parametrize("algorithm", algo_entries())
def test_what_a_gpu_learned_is_resumed_on_a_cpu(algorithm: str) -> None:
    task = "tracking" if algorithm == "ddpg" else "visitors"
    entry, config, spec = algo_entry(algorithm), configured(algorithm, "independent"), prepared(task).spec
    state = trained(task, entry, config, "cuda").state
    other_seeds = tuple(seed + 1 for seed in seeds_of(task, entry))
    resumed = entry.learner(config, spec.for_policies, other_seeds, "cpu")
    resumed.load_state_dict(reloaded(dict(state)))
    assert_equal(tensors(resumed.state_dict()), tensors(dict(state)))


def test_kfac_is_refused_for_recurrent_networks() -> None:
    with pytest.raises(HeadwayError, match=r"model\.core must be none with kfac"):
        configured("maacktr", "shared", **RECURRENT)


@pytest.mark.parametrize("algorithm", REPLAYING)
def test_off_policy_algorithms_have_no_recurrent_core(algorithm: str) -> None:
    with pytest.raises(HeadwayError, match=r"core is not a key of .*; available: activation, hidden"):
        configured(algorithm, "shared", **RECURRENT)


def test_tasks_cover_action_spaces_and_optional_features() -> None:
    specs = [prepared(task).spec for task in TASKS if task not in ("intersection", "junctions")]
    assert {type(spec.action_space) for spec in specs} == {Discrete, MultiDiscrete, Box}
    for feature in ("agents_come_and_go", "has_action_mask", "shared_reward", "groups"):
        assert {bool(getattr(spec, feature)) for spec in specs} == {True, False}
