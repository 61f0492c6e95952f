"""The rollout plan: everything that determines a run's random draws, and its division into shards.

The numbers (seeds of the stack, copies, steps, block, workers) are stored in the run's `plan.json` and used
again on resume.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

from headway.contracts import BatchedEnv, Contributor, EnvSpec, HeadwayError, Rule, TrajectoryLayout
from headway.contracts.acting_policy import ActingPolicy, Parameters, hidden_size
from headway.rollout.scaled_actions import ScaledActions

EVALUATION_BLOCK = 10
"""Evaluation episodes per batch, the same on every backend."""


@dataclass(frozen=True)
class Shard:
    """The copies that one worker steps: the same range of copies of each of several replicas."""

    first_replica: int
    replicas: int
    """Number of replicas."""
    first: int
    """First copy of each replica."""
    count: int
    """Number of copies of each replica."""


def copies_limit_text(spec: EnvSpec, limit: int) -> str:
    """Return the limit in words, for messages."""
    copies = "1 copy" if limit == 1 else f"{limit} copies"
    return f"a process can hold {copies} of {spec.name}"


def replica_groups(limit: int | None, replicas: int, block: int) -> list[tuple[int, int]]:
    """Divide the replicas into groups with separate workers; return (first, number) per group.

    All replicas form one group unless one block of each exceeds `limit`, the copies allowed per process.
    Otherwise there are as few groups as possible, of sizes as equal as possible.
    """
    number = 1 if limit is None else -(-replicas // max(limit // block, 1))
    edges = [replicas * i // number for i in range(number + 1)]
    return [(edges[i], edges[i + 1] - edges[i]) for i in range(number)]


def within_limit(limit: int, replicas: int, copies: int, block: int) -> tuple[int, int]:
    """Return (block, workers) with which no process holds more than `limit` copies.

    The block is the largest divisor of `copies` up to `block` and `limit`, independent of the number of
    replicas. The number of workers is the smallest possible.
    """
    block = max(size for size in range(1, min(limit, block) + 1) if copies % size == 0)
    groups = replica_groups(limit, replicas, block)
    most_copies = limit // max(number for _, number in groups)
    return block, len(groups) * -(-(copies // block) // (most_copies // block))


def evaluation_block(spec: EnvSpec) -> int:
    """Return the number of evaluation episodes per replica and batch, within the environment's limit."""
    # Independent of the number of replicas: a policy's last bits depend on the number of rows in a batch.
    limit = spec.max_copies_per_process
    return EVALUATION_BLOCK if limit is None else min(EVALUATION_BLOCK, limit)


def restart_purpose(iteration: int) -> str:
    """Return the seed purpose of episodes that restart after `iteration`, distinct for every iteration."""
    return f"env restart {iteration}"


@dataclass(frozen=True)
class RolloutPlan:
    """The rollouts of one stack of seeds on one environment. Picklable: every worker gets a copy."""

    make_env: Callable[[Any, int], BatchedEnv]
    """The environment entry's `make`."""
    preload: tuple[str, ...]
    """Modules that the forkserver imports before it starts workers."""
    prepared: Any
    """Result of the entry's `prepare` for the evaluation environment."""
    spec: EnvSpec
    """Specification of the training environment, with actions in the units of the policy."""
    policy: ActingPolicy
    seeds: tuple[int, ...]
    """Seeds of the R replicas."""
    copies: int
    """E, copies per replica."""
    steps: int
    """T, steps per iteration."""
    block: int
    """Copies per replica in one inference batch."""
    training_prepared: Any = None
    """Result of `prepare` for the training environment; None: same as `prepared`."""
    rule: Rule | None = None
    """Rule of the training environment that acts in the first iterations instead of the policy."""
    rule_iterations: int = 0
    """Number of first iterations in which `rule` acts."""
    stage: int = 0
    """Index of the training stage, from 0. The first episodes of each stage have different seeds."""
    make_contributor: Callable[[], Contributor] | None = None
    """Makes the contributor of a worker of asynchronous training, which has a single seed; None: training is
    synchronous."""

    @property
    def seed_purpose(self) -> str:
        """Purpose of the random stream of the first episodes' seeds."""
        return f"env stage {self.stage}" if self.stage else "env"

    @property
    def replicas(self) -> int:
        """R, number of replicas."""
        return len(self.seeds)

    @property
    def layout(self) -> TrajectoryLayout:
        """Layout of the trajectory of all copies, which the workers fill together."""
        return TrajectoryLayout(self.spec, self.steps, self.replicas * self.copies, hidden_size(self.policy))

    @property
    def evaluation_plan(self) -> "RolloutPlan":
        """Plan of a process that only evaluates, with a minimal trajectory."""
        block = evaluation_block(self.spec)
        return replace(self, copies=block, block=block, steps=1, make_contributor=None)

    @property
    def groups(self) -> list[tuple[int, int]]:
        """Replica groups as (first, number), see `replica_groups`."""
        return replica_groups(self.spec.max_copies_per_process, self.replicas, self.block)

    @property
    def whole(self) -> Shard:
        """Shard of all copies of all replicas."""
        return Shard(0, self.replicas, 0, self.copies)

    def of_replicas(self, first: int, number: int) -> "RolloutPlan":
        """Return the plan for some of the seeds, with unchanged draws and blocks."""
        return replace(self, seeds=self.seeds[first : first + number])

    def parameters_of(self, parameters: Parameters, first: int, number: int) -> Parameters:
        """Return views of the parameters of some of the replicas."""
        return {
            name: array[len(array) // self.replicas * first :][: len(array) // self.replicas * number]
            for name, array in parameters.items()
        }

    def make(self, copies: int) -> BatchedEnv:
        """Return the evaluation environment with `copies` copies per replica."""
        return self._in_policy_units(self.make_env(self.prepared, self.replicas * copies))

    def make_for_training(self, copies: int) -> BatchedEnv:
        """Return the training environment with `copies` copies per replica."""
        prepared = self.prepared if self.training_prepared is None else self.training_prepared
        return self._in_policy_units(self.make_env(prepared, self.replicas * copies))

    def _in_policy_units(self, env: BatchedEnv) -> BatchedEnv:
        return env if env.spec.action_space == self.spec.action_space else ScaledActions(env, self.spec)

    def shards(self, workers: int) -> list[Shard]:
        """Divide the copies into one shard per worker, each of whole blocks and as equal as possible.

        With fewer blocks than workers there are fewer shards. Raises HeadwayError if a worker would hold more
        copies than the environment allows per process.
        """
        blocks, groups, limit = self.copies // self.block, self.groups, self.spec.max_copies_per_process
        per_group = min(workers // len(groups), blocks)  # 0 if there are more groups than workers
        edges = [blocks * i // per_group * self.block for i in range(per_group + 1)] if per_group else []
        shards = [
            Shard(*group, edges[i], edges[i + 1] - edges[i]) for group in groups for i in range(per_group)
        ]
        if limit is not None and (not shards or max(each.replicas * each.count for each in shards) > limit):
            raise HeadwayError(
                f"{copies_limit_text(self.spec, limit)}, and a worker would hold more; "
                f"set {self._within(limit)}"
            )
        return shards

    @property
    def block_shards(self) -> list[Shard]:
        """Shards of one block each, for asynchronous training: all rollouts have the same size.

        Raises HeadwayError as `shards` does.
        """
        return self.shards(self.copies // self.block)

    def require_one_process(self) -> None:
        """Raise HeadwayError if all copies of all replicas exceed the environment's limit per process."""
        limit = self.spec.max_copies_per_process
        if limit is not None and self.replicas * self.copies > limit:
            raise HeadwayError(
                f"{copies_limit_text(self.spec, limit)}, and with backend=serial one would hold more; set "
                f"backend=process, {self._within(limit)}"
            )

    def _within(self, limit: int) -> str:
        """Return settings, for messages, with which no worker process holds more than `limit` copies."""
        block, workers = within_limit(limit, self.replicas, self.copies, self.copies)
        return f"rollout.block={block} and backend.workers={workers}"
