"""What decides the draws of a run, and how its copies are dealt out to workers. A run's `plan.json` keeps
the numbers (seeds of the stack, copies, steps, block, workers), and a resumed run takes them from there."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Self

from headway.config import RolloutConfig
from headway.contracts import BatchedEnv, EnvSpec, HeadwayError, TrajectoryLayout
from headway.contracts.acting import ActingPolicy, memory_size

EVALUATION_BLOCK = 10
"""Evaluation episodes run at once, the same on every backend."""


def evaluation_block(spec: EnvSpec, replicas: int) -> int:
    """Evaluation episodes of each replica run at once: fewer where a process may hold few copies."""
    limit = spec.max_copies_per_process
    return EVALUATION_BLOCK if limit is None else max(min(EVALUATION_BLOCK, limit // replicas), 1)


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
        return TrajectoryLayout(self.spec, self.steps, self.replicas * self.copies, memory_size(self.policy))

    @property
    def evaluating_apart(self) -> "RolloutPlan":
        """The plan of a process that does nothing but evaluate, with hardly a trajectory."""
        block = evaluation_block(self.spec, self.replicas)
        return replace(self, copies=block, block=block, steps=1)

    def make(self, copies: int) -> BatchedEnv:
        """The environment that is reported on, `copies` copies of each replica."""
        return self.make_env(self.prepared, self.replicas * copies)

    def make_for_training(self, copies: int) -> BatchedEnv:
        """The environment that is learned from, `copies` copies of each replica."""
        prepared = self.prepared if self.training_prepared is None else self.training_prepared
        return self.make_env(prepared, self.replicas * copies)

    def shards(self, workers: int) -> list[tuple[int, int]]:
        """(first, count) copies of each worker: whole blocks, as equal as can be, none empty.

        Raises HeadwayError where a worker would hold more copies than the environment allows in a process.
        """
        blocks = self.copies // self.block
        used = min(workers, blocks)
        edges = [blocks * i // used * self.block for i in range(used + 1)]
        shards = [(edges[i], edges[i + 1] - edges[i]) for i in range(used)]
        most, limit = max(count for _, count in shards) * self.replicas, self.spec.max_copies_per_process
        if limit is not None and most > limit:
            raise HeadwayError(
                f"{self.spec.name} allows {limit} copies in a process, and a worker would hold {most}; "
                f"set {self._settings_within(limit)}"
            )
        return shards

    def _settings_within(self, limit: int) -> str:
        """Settings with which no worker holds more than `limit` copies."""
        most = limit // self.replicas
        if most == 0:
            return f"backend.stack={limit} or less"
        block = max(size for size in range(1, most + 1) if self.copies % size == 0)
        workers = -(-(self.copies // block) // (most // block))
        return f"rollout.block={block} and backend.workers={workers}"
