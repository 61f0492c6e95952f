"""Rollouts in the training process, for debugging and tests."""

from typing import Any

from headway.contracts import Trajectory
from headway.contracts.acting_policy import Parameters
from headway.rollout.collector import Collector, require_shards, restart_purpose
from headway.rollout.plan import RolloutPlan
from headway.rollout.sampler import Episode, Sampler, sort_episodes


class SerialCollector(Collector):
    """A collector that samples and evaluates in the calling process."""

    def __init__(self, plan: RolloutPlan) -> None:
        """Raise HeadwayError if all copies exceed the environment's limit per process."""
        plan.require_one_process()
        self.plan = plan
        self.trajectory = Trajectory.allocate(plan.layout)
        self.sampler = Sampler(plan, plan.whole, self.trajectory)

    def begin(self) -> None:
        self.sampler.begin(self.plan.seed_purpose)

    def collect(self, iteration: int, parameters: Parameters) -> list[Episode]:
        return sort_episodes(self.sampler.collect(iteration, parameters))

    def snapshot(self) -> list[Any]:
        return [self.sampler.snapshot()]

    def restore(self, snapshots: list[Any], iteration: int) -> None:
        require_shards(snapshots, 1)
        if snapshots[0] is None:
            self.sampler.begin(restart_purpose(iteration))
        else:
            self.sampler.restore(snapshots[0])

    def _close(self) -> None:
        self.sampler.env.close()
