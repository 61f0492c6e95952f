"""What decides the draws of a run, and how its copies are dealt out to workers. A run's `plan.json` keeps
the numbers (seeds of the stack, copies, steps, block, workers), and a resumed run takes them from there."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Self

from headway.config.experiment import RolloutConfig
from headway.contracts import BatchedEnv, EnvSpec, HeadwayError, TrajectoryLayout
from headway.contracts.acting_policy import ActingPolicy, Parameters, hidden_size

EVALUATION_BLOCK = 10
"""Evaluation episodes run at once, the same on every backend."""


@dataclass(frozen=True)
class Shard:
    """What one worker holds: some copies of some replicas, as many of each."""

    first_replica: int
    replicas: int
    first: int
    """Of its copies of each of these replicas."""
    count: int


def process_holds(spec: EnvSpec, limit: int) -> str:
    """The limit in words."""
    copies = "1 copy" if limit == 1 else f"{limit} copies"
    return f"a process can hold {copies} of {spec.name}"


def replica_groups(limit: int | None, replicas: int, block: int) -> list[tuple[int, int]]:
    """(first, number) replicas of which one worker holds copies: all of them together, unless a block of
    each is more than the `limit` of copies in a process; then as few groups as can be, as equal as can be."""
    number = 1 if limit is None else -(-replicas // max(limit // block, 1))
    edges = [replicas * i // number for i in range(number + 1)]
    return [(edges[i], edges[i + 1] - edges[i]) for i in range(number)]


def within_limit(limit: int, replicas: int, copies: int, block: int) -> tuple[int, int]:
    """(block, workers) with which no process holds more than `limit` copies: the largest block up to `block`
    that divides `copies`, whatever the number of replicas, and the fewest workers."""
    block = max(size for size in range(1, min(limit, block) + 1) if copies % size == 0)
    groups = replica_groups(limit, replicas, block)
    most = limit // max(number for _, number in groups)
    return block, len(groups) * -(-(copies // block) // (most // block))


def evaluation_block(spec: EnvSpec) -> int:
    """Evaluation episodes of each replica run at once: fewer where a process may hold few copies. The same
    for any number of replicas, as the last bits of a policy's outputs depend on how many rows it is given."""
    limit = spec.max_copies_per_process
    return EVALUATION_BLOCK if limit is None else min(EVALUATION_BLOCK, limit)


@dataclass(frozen=True)
class RolloutPlan:
    """One stack of seeds on one environment. Picklable: workers are given it whole."""

    make_env: Callable[[Any, int], BatchedEnv]
    """The environment entry's `make`."""
    preload: tuple[str, ...]
    prepared: Any
    """What the entry's `prepare` gave for the environment that is reported on."""
    spec: EnvSpec
    """What is learned from: the training environment's."""
    policy: ActingPolicy
    seeds: tuple[int, ...]
    """Seeds of the R replicas."""
    copies: int
    """E: copies of each replica."""
    steps: int
    """T"""
    block: int
    """Copies of each replica whose actions are computed in one piece."""
    training_prepared: Any = None
    """What `prepare` gave for the environment that is learned from; None: the same."""

    @classmethod
    def of(
        cls,
        rollout: RolloutConfig,
        make_env: Callable[[Any, int], BatchedEnv],
        preload: tuple[str, ...],
        prepared: object,
        spec: EnvSpec,
        policy: ActingPolicy,
        seeds: tuple[int, ...],
        training_prepared: object = None,
    ) -> Self:
        """The plan with the numbers of a configuration."""
        numbers = {"copies": rollout.copies, "steps": rollout.steps, "block": rollout.block}
        return cls(
            make_env, preload, prepared, spec, policy, seeds, training_prepared=training_prepared, **numbers
        )

    @property
    def replicas(self) -> int:
        """R"""
        return len(self.seeds)

    @property
    def layout(self) -> TrajectoryLayout:
        """Of the trajectory that all workers fill together."""
        return TrajectoryLayout(self.spec, self.steps, self.replicas * self.copies, hidden_size(self.policy))

    @property
    def evaluating_apart(self) -> "RolloutPlan":
        """The plan of a process that does nothing but evaluate, with hardly a trajectory."""
        block = evaluation_block(self.spec)
        return replace(self, copies=block, block=block, steps=1)

    @property
    def groups(self) -> list[tuple[int, int]]:
        """(first, number) replicas that one process holds copies of at once."""
        return replica_groups(self.spec.max_copies_per_process, self.replicas, self.block)

    @property
    def whole(self) -> Shard:
        """All copies of all replicas."""
        return Shard(0, self.replicas, 0, self.copies)

    def of_replicas(self, first: int, number: int) -> "RolloutPlan":
        """The same plan of fewer seeds: their draws and their blocks are those of this one."""
        return replace(self, seeds=self.seeds[first : first + number])

    def parameters_of(self, parameters: Parameters, first: int, number: int) -> Parameters:
        """Views of the parameters of some of the replicas."""
        return {
            name: array[len(array) // self.replicas * first :][: len(array) // self.replicas * number]
            for name, array in parameters.items()
        }

    def make(self, copies: int) -> BatchedEnv:
        """The environment that is reported on, `copies` copies of each replica."""
        return self.make_env(self.prepared, self.replicas * copies)

    def make_for_training(self, copies: int) -> BatchedEnv:
        """The environment that is learned from, `copies` copies of each replica."""
        prepared = self.prepared if self.training_prepared is None else self.training_prepared
        return self.make_env(prepared, self.replicas * copies)

    def shards(self, workers: int) -> list[Shard]:
        """What each worker holds: whole blocks of the copies of a group of replicas, as equal as can be, none
        empty.

        Raises HeadwayError where a worker would hold more copies than the environment allows in a process.
        """
        blocks, groups, limit = self.copies // self.block, self.groups, self.spec.max_copies_per_process
        used = min(workers // len(groups), blocks)  # for each group; none where there are more groups
        edges = [blocks * i // used * self.block for i in range(used + 1)] if used else []
        shards = [Shard(*group, edges[i], edges[i + 1] - edges[i]) for group in groups for i in range(used)]
        if limit is not None and (not shards or max(each.replicas * each.count for each in shards) > limit):
            raise HeadwayError(
                f"{process_holds(self.spec, limit)}, and a worker would hold more; set {self._within(limit)}"
            )
        return shards

    def require_one_process(self) -> None:
        """Raise HeadwayError where one process may not hold all copies of all replicas."""
        limit = self.spec.max_copies_per_process
        if limit is not None and self.replicas * self.copies > limit:
            raise HeadwayError(
                f"{process_holds(self.spec, limit)}, and with backend=serial one would hold more; set "
                f"backend=process, {self._within(limit)}"
            )

    def _within(self, limit: int) -> str:
        """Settings with which no worker process holds more than `limit` copies."""
        block, workers = within_limit(limit, self.replicas, self.copies, self.copies)
        return f"rollout.block={block} and backend.workers={workers}"
