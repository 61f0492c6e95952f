"""Backends: workers that step environments, to collect experience or to contribute gradients."""

from abc import ABC, abstractmethod
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any

from headway.contracts import HeadwayError, Trajectory
from headway.contracts.acting_policy import Parameters
from headway.events import Row, Usage
from headway.rollout.episodes import EvaluationRequest, evaluate_policy
from headway.rollout.plan import RolloutPlan
from headway.rollout.sampler import Episode
from headway.rollout.workers.worker import Contribute, Done

if TYPE_CHECKING:
    from headway.rollout.workers.worker_pool import WorkerPool


class Backend(ABC):
    """A set of workers that step environments. They evaluate too, unless it has an `evaluator`."""

    plan: RolloutPlan
    pool: "WorkerPool | None" = None
    """Workers in processes of their own; None: this process steps the environments."""
    evaluator: "Collector | None" = None
    """Collector in other processes that only evaluates; closed with this backend. None: there is none."""

    @abstractmethod
    def begin(self) -> None:
        """Start the first episodes."""

    @abstractmethod
    def snapshot(self) -> list[Any]:
        """Return one snapshot per shard, for a checkpoint; None for environments without snapshots."""

    @abstractmethod
    def restore(self, snapshots: list[Any], iteration: int) -> None:
        """Continue from the snapshots of a checkpoint written after `iteration`.

        A shard whose snapshot is None starts new episodes. Raises HeadwayError if the snapshots belong to a
        different number of workers.
        """

    def evaluate(self, root: int, episodes: int, greedy: bool, parameters: Parameters) -> list[list[Row]]:
        """Play evaluation episodes; return one list per replica, with one row per episode.

        `root` is the root of the evaluation seeds.
        """
        if self.evaluator is not None:
            return self.evaluator.evaluate(root, episodes, greedy, parameters)
        requests = EvaluationRequest.split(root, episodes, greedy, self.plan.spec)
        return self._play(requests, parameters)

    def _play(self, requests: Sequence[EvaluationRequest], parameters: Parameters) -> list[list[Row]]:
        """Play evaluation episodes, here: in this process, one block after another."""
        return concatenate_blocks([evaluate_policy(self.plan, parameters, request) for request in requests])

    def process_ids(self) -> list[int]:
        """Return the ids of the worker processes on this machine."""
        own = [] if self.pool is None else self.pool.process_ids()
        return own if self.evaluator is None else own + self.evaluator.process_ids()

    def usage(self) -> Usage:
        """Return the sum of the workers' most recently reported usage."""
        own = Usage() if self.pool is None else self.pool.usage()
        return own if self.evaluator is None else own + self.evaluator.usage()

    def close(self) -> None:
        """End the workers and close their environments."""
        try:
            self._close()
        finally:
            if self.evaluator is not None:
                self.evaluator.close()

    def _close(self) -> None:
        assert self.pool is not None
        self.pool.close()


class Collector(Backend):
    """A backend of synchronous training: samples and evaluates with given parameters."""

    trajectory: Trajectory
    """Experience of the last `collect`, which overwrites it."""

    @abstractmethod
    def collect(self, iteration: int, parameters: Parameters) -> list[Episode]:
        """Sample one iteration; return the episodes that ended in it, by replica, copy and time."""


class Contributors(Backend):
    """A backend of asynchronous training: each worker computes contributions from one block of copies."""

    in_turns: bool
    """Workers contribute one after another, in a fixed order."""
    number: int
    """Number of workers, and of contributions per iteration."""
    tasks: dict[int, Contribute]
    """Current task by worker, in order of assignment."""

    def idle(self) -> list[int]:
        """Return the workers without a task, in order."""
        return [worker for worker in range(self.number) if worker not in self.tasks]

    @abstractmethod
    def assign(self, worker: int, task: Contribute) -> None:
        """Start a contribution on an idle worker."""

    @abstractmethod
    def next_done(self, turn: int | None) -> tuple[int, Contribute, Done]:
        """Wait for a contribution; return the worker, which is idle again, its task and the result.

        `turn` names the worker to wait for; None: the first one to finish.
        """


def concatenate_blocks(parts: Iterable[list[list[Row]]]) -> list[list[Row]]:
    """Concatenate the blocks of an evaluation, each a list of rows per replica."""
    return [[row for rows in of_replica for row in rows] for of_replica in zip(*parts, strict=True)]


def require_shards(snapshots: list[Any], shards: int) -> None:
    """Raise HeadwayError unless a checkpoint has one snapshot per shard."""
    if len(snapshots) != shards:
        raise HeadwayError(
            f"the checkpoint was made with {len(snapshots)} workers, not with {shards}; "
            f'set "workers" in the run\'s plan.json to {len(snapshots)}, and backend.name as it was'
        )


def restart_purpose(iteration: int) -> str:
    """Return the seed purpose of episodes that restart after `iteration`, distinct for every iteration."""
    return f"env restart {iteration}"
