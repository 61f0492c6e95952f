"""Rollouts in a pool of workers, one shard of the copies per worker."""

from collections.abc import Sequence
from typing import Any

from headway.contracts.acting_policy import Parameters
from headway.events import Row
from headway.rollout.collector import Collector, concatenate_blocks, require_shards, restart_purpose
from headway.rollout.episodes import EvaluationRequest
from headway.rollout.plan import RolloutPlan
from headway.rollout.sampler import Episode, sort_episodes
from headway.rollout.workers.worker import Begin, Collect, Evaluate
from headway.rollout.workers.worker_pool import Notify, WorkerLauncher, WorkerPool, resume_command


class PoolCollector(Collector):
    """A collector whose workers fill one trajectory, all with the same parameters."""

    pool: WorkerPool

    def __init__(
        self,
        plan: RolloutPlan,
        launcher: WorkerLauncher,
        number: int,
        notify: Notify,
        timeout_s: float | None = None,
    ) -> None:
        self.plan, self.launcher, self.trajectory = plan, launcher, launcher.trajectory
        self.pool = WorkerPool(launcher, number, notify, plan.spec.name, timeout_s)

    def begin(self) -> None:
        self.pool.all([Begin(self.plan.seed_purpose)] * len(self.pool.workers))

    def collect(self, iteration: int, parameters: Parameters) -> list[Episode]:
        """Sample one iteration in all workers at once; a worker that dies is replaced and samples again."""
        self.launcher.publish(parameters)
        done = self.pool.all([Collect(iteration)] * len(self.pool.workers))
        self.pool.restart_purpose = restart_purpose(iteration)
        return sort_episodes(episode for part in done for episode in part.episodes)

    def _play(self, requests: Sequence[EvaluationRequest], parameters: Parameters) -> list[list[Row]]:
        """Play evaluation episodes.

        Each task is one block of episodes of one replica group; the workers take the tasks in turn.
        """
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
