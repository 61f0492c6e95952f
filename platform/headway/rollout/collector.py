"""Backends: workers that step environments, to collect experience or to contribute gradients."""

from collections.abc import Iterable
from contextlib import ExitStack
from dataclasses import dataclass
from typing import Any, Protocol

from headway.contracts import HeadwayError, Trajectory
from headway.contracts.acting_policy import Parameters
from headway.events import Row, Usage
from headway.rollout.episodes import EvaluationRequest, evaluate_policy
from headway.rollout.plan import RolloutPlan
from headway.rollout.sampler import Episode
from headway.rollout.workers.worker import Contribute, Done


class Evaluator(Protocol):
    """Plays evaluation episodes, in workers or in this process."""

    def evaluate(self, root: int, episodes: int, greedy: bool, parameters: Parameters) -> list[list[Row]]:
        """Play evaluation episodes; return one list per replica, with one row per episode.

        `root` is the root of the evaluation seeds.
        """
        ...

    def process_ids(self) -> list[int]:
        """Return the ids of the worker processes on this machine."""
        ...

    def usage(self) -> Usage:
        """Return the sum of the workers' most recently reported usage."""
        ...

    def close(self) -> None:
        """End the workers and close their environments."""


class Backend(Evaluator, Protocol):
    """A set of workers that step environments; an evaluator of its own may play the evaluation episodes."""

    def begin(self) -> None:
        """Start the first episodes."""

    def snapshot(self) -> list[Any]:
        """Return one snapshot per shard, for a checkpoint; None for environments without snapshots."""
        ...

    def restore(self, snapshots: list[Any], iteration: int) -> None:
        """Continue from the snapshots of a checkpoint written after `iteration`.

        A shard whose snapshot is None starts new episodes. Raises HeadwayError if the snapshots belong to a
        different number of workers.
        """


class Collector(Backend, Protocol):
    """A backend of synchronous training: samples and evaluates with given parameters."""

    trajectory: Trajectory
    """Experience of the last `collect`, which overwrites it."""

    def collect(self, iteration: int, parameters: Parameters) -> list[Episode]:
        """Sample one iteration; return the episodes that ended in it, by replica, copy and time."""
        ...


class Contributors(Backend, Protocol):
    """A backend of asynchronous training: each worker computes contributions from one block of copies."""

    in_turns: bool
    """Workers contribute one after another, in a fixed order."""
    number: int
    """Number of workers, and of contributions per iteration."""
    tasks: dict[int, Contribute]
    """Current task by worker, in order of assignment; the other workers are idle."""

    def assign(self, worker: int, task: Contribute) -> None:
        """Start a contribution on an idle worker."""

    def next_done(self, turn: int | None) -> tuple[int, Contribute, Done]:
        """Wait for a contribution; return the worker, which is idle again, its task and the result.

        `turn` names the worker to wait for; None: the first one to finish.
        """
        ...


class _Closable(Protocol):
    def close(self) -> None: ...


def close_all(parts: Iterable[_Closable]) -> None:
    """Close all parts in order, also those after one that fails."""
    with ExitStack() as stack:
        for part in reversed(list(parts)):
            stack.callback(part.close)


@dataclass(frozen=True)
class InProcessEvaluator:
    """Evaluates in this process, one block after another."""

    plan: RolloutPlan

    def evaluate(self, root: int, episodes: int, greedy: bool, parameters: Parameters) -> list[list[Row]]:
        requests = EvaluationRequest.split(root, episodes, greedy, self.plan.spec)
        return concatenate_blocks([evaluate_policy(self.plan, parameters, request) for request in requests])

    def process_ids(self) -> list[int]:
        return []

    def usage(self) -> Usage:
        return Usage()

    def close(self) -> None:
        """Return: every evaluation has closed its environment."""


class SerialBackend:
    """What backends in the calling process share; they evaluate there too, unless `evaluator` is given."""

    def __init__(self, plan: RolloutPlan, evaluator: Evaluator | None = None) -> None:
        """Raise HeadwayError if all copies exceed the environment's limit per process."""
        plan.require_one_process()
        self.plan, self.evaluator = plan, evaluator or InProcessEvaluator(plan)

    def evaluate(self, root: int, episodes: int, greedy: bool, parameters: Parameters) -> list[list[Row]]:
        return self.evaluator.evaluate(root, episodes, greedy, parameters)

    def process_ids(self) -> list[int]:
        return self.evaluator.process_ids()

    def usage(self) -> Usage:
        return self.evaluator.usage()


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
