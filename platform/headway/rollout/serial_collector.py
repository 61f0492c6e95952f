"""Rollouts in the training process, for debugging and tests."""

from typing import Any

from headway.contracts import Trajectory
from headway.contracts.acting_policy import Parameters
from headway.rollout.collector import Evaluator, SerialBackend, close_all, require_shards
from headway.rollout.plan import RolloutPlan, restart_purpose
from headway.rollout.sampler import Episode, Sampler, sort_episodes


class SerialCollector(SerialBackend):
    """A `Collector` that samples in the calling process."""

    def __init__(self, plan: RolloutPlan, evaluator: Evaluator | None = None) -> None:
        super().__init__(plan, evaluator)
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

    def close(self) -> None:
        close_all([self.sampler.env, self.evaluator])
