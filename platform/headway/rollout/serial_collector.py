"""Rollouts in the training process, for debugging and tests."""

from typing import Any

from headway.contracts import Trajectory
from headway.contracts.acting_policy import Parameters
from headway.events import Row, Usage
from headway.rollout.collector import concatenate_blocks, require_shards, restart_purpose
from headway.rollout.episodes import EvaluationRequest, evaluate_policy
from headway.rollout.plan import RolloutPlan
from headway.rollout.sampler import Episode, Sampler, sort_episodes


class SerialCollector:
    """A collector that samples and evaluates in the calling process."""

    def __init__(self, plan: RolloutPlan) -> None:
        """Raise HeadwayError if all copies exceed the environment's limit per process."""
        plan.require_one_process()
        self.plan = plan
        self.trajectory = Trajectory.allocate(plan.layout)
        self.sampler = Sampler(plan, plan.whole, self.trajectory)

    def begin(self) -> None:
        """Start the first episodes."""
        self.sampler.begin(self.plan.seed_purpose)

    def collect(self, iteration: int, parameters: Parameters) -> list[Episode]:
        """Sample one iteration."""
        return sort_episodes(self.sampler.collect(iteration, parameters))

    def evaluate(self, root: int, episodes: int, greedy: bool, parameters: Parameters) -> list[list[Row]]:
        """Play evaluation episodes, one block after another."""
        requests = EvaluationRequest.split(root, episodes, greedy, self.plan.spec)
        return concatenate_blocks([evaluate_policy(self.plan, parameters, request) for request in requests])

    def snapshot(self) -> list[Any]:
        """Return the snapshot of the only shard."""
        return [self.sampler.snapshot()]

    def restore(self, snapshots: list[Any], iteration: int) -> None:
        """Continue from a checkpoint; start new episodes if it holds no snapshot."""
        require_shards(snapshots, 1)
        if snapshots[0] is None:
            self.sampler.begin(restart_purpose(iteration))
        else:
            self.sampler.restore(snapshots[0])

    def process_ids(self) -> list[int]:
        """Return an empty list: there are no worker processes."""
        return []

    def usage(self) -> Usage:
        """Return zero usage: there are no worker processes."""
        return Usage()

    def close(self) -> None:
        """Close the environment."""
        self.sampler.env.close()
