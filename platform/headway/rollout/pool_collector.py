"""Rollouts in a pool of workers, one shard of the copies per worker."""

from typing import Any, Protocol

from headway.contracts import Trajectory
from headway.contracts.acting_policy import Parameters
from headway.events import Row, Usage
from headway.rollout.collector import Evaluator, close_all, concatenate_blocks, require_shards
from headway.rollout.episodes import EvaluationRequest
from headway.rollout.plan import RolloutPlan, restart_purpose
from headway.rollout.sampler import Episode, sort_episodes
from headway.rollout.workers.worker import Begin, Collect, Evaluate
from headway.rollout.workers.worker_pool import Notify, WorkerLauncher, WorkerPool, resume_command


class SamplingLauncher(WorkerLauncher, Protocol):
    """Starts workers of synchronous training; moves parameters to them, and experience back."""

    @property
    def trajectory(self) -> Trajectory:
        """Experience of all workers, complete once they have answered."""
        ...

    def publish(self, parameters: Parameters) -> None:
        """Send the acting parameters, arrays (P, ...) by name, which all workers use until the next call."""
        ...


class PoolCollector:
    """A `Collector` whose workers fill one trajectory, all with the same parameters.

    They evaluate too, unless `evaluator` is given.
    """

    def __init__(
        self,
        plan: RolloutPlan,
        launcher: SamplingLauncher,
        number: int,
        notify: Notify,
        timeout_s: float | None = None,
        evaluator: Evaluator | None = None,
    ) -> None:
        self.plan, self.launcher, self.trajectory = plan, launcher, launcher.trajectory
        self.evaluator = evaluator
        self.pool = WorkerPool(launcher, number, notify, plan.spec.name, timeout_s)

    def begin(self) -> None:
        self.pool.all([Begin(self.plan.seed_purpose)] * len(self.pool.workers))

    def collect(self, iteration: int, parameters: Parameters) -> list[Episode]:
        """Sample one iteration in all workers at once; a worker that dies is replaced and samples again."""
        self.launcher.publish(parameters)
        done = self.pool.all([Collect(iteration)] * len(self.pool.workers))
        self.pool.restart_purpose = restart_purpose(iteration)
        return sort_episodes(episode for part in done for episode in part.episodes)

    def evaluate(self, root: int, episodes: int, greedy: bool, parameters: Parameters) -> list[list[Row]]:
        """Play evaluation episodes.

        Each task is one block of episodes of one replica group; the workers take the tasks in turn.
        """
        if self.evaluator is not None:
            return self.evaluator.evaluate(root, episodes, greedy, parameters)
        requests = EvaluationRequest.split(root, episodes, greedy, self.plan.spec)
        self.launcher.publish(parameters)
        tasks = [Evaluate(request, *group) for group in self.plan.groups for request in requests]
        played: list[list[list[Row]]] = []
        for start in range(0, len(tasks), len(self.pool.workers)):
            done = self.pool.all(tasks[start : start + len(self.pool.workers)])
            played += [each.evaluation for each in done]
        group_starts = range(0, len(tasks), len(requests))
        return [
            rows
            for start in group_starts
            for rows in concatenate_blocks(played[start : start + len(requests)])
        ]

    def snapshot(self) -> list[Any]:
        """Return one snapshot per worker, taken at the end of the last iteration."""
        return [worker.snapshot for worker in self.pool.workers]

    def restore(self, snapshots: list[Any], iteration: int) -> None:
        require_shards(snapshots, len(self.pool.workers))
        self.pool.restart_purpose = restart_purpose(iteration)
        self.pool.all([resume_command(snapshot, self.pool.restart_purpose) for snapshot in snapshots])

    def process_ids(self) -> list[int]:
        return self.pool.process_ids() + (self.evaluator.process_ids() if self.evaluator else [])

    def usage(self) -> Usage:
        return self.pool.usage() + (self.evaluator.usage() if self.evaluator else Usage())

    def close(self) -> None:
        close_all([self.pool, self.evaluator] if self.evaluator else [self.pool])
