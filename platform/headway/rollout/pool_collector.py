"""Rollouts by a crew of workers, each with a shard of the copies."""

from typing import Any, Protocol

from headway.contracts import Trajectory
from headway.contracts.acting_policy import Parameters
from headway.events import Row, Usage
from headway.rollout.collector import evaluation_requests, joined, require_shards, restart_purpose
from headway.rollout.plan import RolloutPlan
from headway.rollout.sampler import Episode, in_order
from headway.rollout.workers.worker import Begin, Collect, Evaluate
from headway.rollout.workers.worker_pool import Notify, WorkerLauncher, WorkerPool, standing


class SamplingTransport(WorkerLauncher, Protocol):
    """A workplace of workers that sample, with the ways there and back: parameters and experience."""

    @property
    def trajectory(self) -> Trajectory:
        """Where the experience of all workers is once they have answered."""
        ...

    def publish(self, parameters: Parameters) -> None:
        """Give out the parameters that all workers use from now on."""
        ...

    def close(self) -> None:
        """Give up what is held for this, when all workers are gone."""
        ...


class PoolCollector:
    """Workers that fill one trajectory with one set of parameters."""

    def __init__(self, plan: RolloutPlan, exchange: SamplingTransport, number: int, notify: Notify) -> None:
        self.plan, self.exchange, self.trajectory = plan, exchange, exchange.trajectory
        try:
            self.crew = WorkerPool(exchange, number, notify)
        except BaseException:
            exchange.close()
            raise

    def begin(self) -> None:
        """Start the first episodes."""
        self.crew.all([Begin("env")] * len(self.crew.workers))

    def collect(self, iteration: int, parameters: Parameters) -> list[Episode]:
        """Sample one iteration in all workers at once; a worker that dies is replaced and samples again."""
        self.exchange.publish(parameters)
        done = self.crew.all([Collect(iteration)] * len(self.crew.workers))
        self.crew.anew = restart_purpose(iteration)
        return in_order(episode for part in done for episode in part.episodes)

    def evaluate(self, root: int, episodes: int, greedy: bool, parameters: Parameters) -> list[list[Row]]:
        """Evaluation episodes, blocks of as many replicas as a process can hold dealt out to the workers in
        turn."""
        self.exchange.publish(parameters)
        requests = evaluation_requests(self.plan, root, episodes, greedy)
        tasks = [Evaluate(request, *group) for group in self.plan.groups for request in requests]
        played: list[list[list[Row]]] = []
        for start in range(0, len(tasks), len(self.crew.workers)):
            done = self.crew.all(tasks[start : start + len(self.crew.workers)])
            played += [each.evaluation for each in done]
        starts = range(0, len(tasks), len(requests))  # of the groups
        return [rows for start in starts for rows in joined(played[start : start + len(requests)])]

    def snapshot(self) -> list[Any]:
        """One a worker, as of the end of the last iteration."""
        return [worker.snapshot for worker in self.crew.workers]

    def restore(self, snapshots: list[Any], iteration: int) -> None:
        """Go on from a checkpoint, or start afresh where it holds no snapshots."""
        require_shards(snapshots, len(self.crew.workers))
        self.crew.anew = restart_purpose(iteration)
        self.crew.all([standing(snapshot, self.crew.anew) for snapshot in snapshots])

    def process_ids(self) -> list[int]:
        """Worker processes of this machine, by id."""
        return self.crew.process_ids()

    def usage(self) -> Usage:
        """As the workers last reported."""
        return self.crew.usage()

    def close(self) -> None:
        """End the workers, busy ones after some seconds of grace."""
        self.crew.close()
        self.exchange.close()
