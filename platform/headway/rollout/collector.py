"""What every backend is: a collector of experience and evaluations."""

from collections.abc import Iterable
from typing import Any, Protocol

from headway.contracts import HeadwayError, Trajectory
from headway.contracts.acting_policy import Parameters
from headway.events import Row, Usage
from headway.rollout.episodes import EvaluationRequest
from headway.rollout.plan import RolloutPlan, evaluation_block
from headway.rollout.sampler import Episode
from headway.rollout.workers.worker import Contribute, Done


class Backend(Protocol):
    """Where environments are stepped."""

    def begin(self) -> None:
        """Start the first episodes."""
        ...

    def evaluate(self, root: int, episodes: int, greedy: bool, parameters: Parameters) -> list[list[Row]]:
        """Evaluation episodes: one list a replica, one row an episode."""
        ...

    def snapshot(self) -> list[Any]:
        """Where every shard stands, for a checkpoint; entries are None where the environment cannot tell."""
        ...

    def restore(self, snapshots: list[Any], iteration: int) -> None:
        """Go on from the snapshots of a checkpoint after `iteration`; where they are None, start anew.

        Raises HeadwayError if they are those of another number of workers.
        """
        ...

    def process_ids(self) -> list[int]:
        """Worker processes alive."""
        ...

    def usage(self) -> Usage:
        """Of all workers, as far as known."""
        ...

    def close(self) -> None: ...


class Collector(Backend, Protocol):
    """Rollouts and evaluations with given parameters."""

    trajectory: Trajectory
    """Where `collect` leaves the experience; overwritten by the next one."""

    def collect(self, iteration: int, parameters: Parameters) -> list[Episode]:
        """Sample one iteration; the episodes that ended in it, by replica, copy and time."""
        ...


class Contributors(Backend, Protocol):
    """Workers that learn from rollouts of their own, each on one block of the copies."""

    in_turns: bool
    """Whatever is asked for, they contribute one after another."""

    @property
    def number(self) -> int:
        """Workers; an iteration is one contribution of each, on average."""
        ...

    def idle(self) -> list[int]:
        """Workers with nothing to do, in order."""
        ...

    def assign(self, worker: int, task: Contribute) -> None:
        """Have an idle worker make a contribution."""
        ...

    def next_done(self, turn: int | None) -> tuple[int, Contribute, Done]:
        """Wait for a contribution: of the worker `turn`, or None, whichever comes first. Which worker's it
        is, which is idle now; what it had to do, and what it did."""
        ...


def evaluation_requests(plan: RolloutPlan, root: int, episodes: int, greedy: bool) -> list[EvaluationRequest]:
    """An evaluation in the blocks in which every backend plays it."""
    return EvaluationRequest.split(root, episodes, greedy, evaluation_block(plan.spec))


def joined(parts: Iterable[list[list[Row]]]) -> list[list[Row]]:
    """The blocks of an evaluation, each one list a replica, one after another."""
    return [[row for rows in of_replica for row in rows] for of_replica in zip(*parts, strict=True)]


def require_shards(snapshots: list[Any], shards: int) -> None:
    """Raise HeadwayError unless a checkpoint has one snapshot a shard."""
    if len(snapshots) != shards:
        raise HeadwayError(
            f"the checkpoint was made with {len(snapshots)} workers, not with {shards}; "
            f'let "workers" in the run\'s plan.json be {len(snapshots)}, and backend.name what it was'
        )


def restart_purpose(iteration: int) -> str:
    """Purpose of the seeds of episodes that start anew after an iteration: not those of an earlier start."""
    return f"env restart {iteration}"
