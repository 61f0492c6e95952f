"""Rollouts in the training process itself: for debugging and tests."""

from typing import Any

from headway.contracts import Trajectory
from headway.contracts.acting_policy import Parameters
from headway.events import Row, Usage
from headway.rollout.collector import evaluation_requests, joined, require_shards, restart_purpose
from headway.rollout.episodes import evaluate_policy
from headway.rollout.plan import RolloutPlan
from headway.rollout.sampler import Episode, Sampler, in_order


class SerialCollector:
    """Everything in this process: for debugging and tests."""

    def __init__(self, plan: RolloutPlan) -> None:
        """Raises HeadwayError where one process may not hold all copies."""
        plan.require_one_process()
        self.plan = plan
        self.trajectory = Trajectory.allocate(plan.layout)
        self.sampler = Sampler(plan, plan.whole, self.trajectory)

    def begin(self) -> None:
        """Start the first episodes."""
        self.sampler.begin()

    def collect(self, iteration: int, parameters: Parameters) -> list[Episode]:
        """Sample one iteration."""
        return in_order(self.sampler.collect(iteration, parameters))

    def evaluate(self, root: int, episodes: int, greedy: bool, parameters: Parameters) -> list[list[Row]]:
        """Evaluation episodes, block after block."""
        requests = evaluation_requests(self.plan, root, episodes, greedy)
        return joined([evaluate_policy(self.plan, parameters, request) for request in requests])

    def snapshot(self) -> list[Any]:
        """One shard."""
        return [self.sampler.snapshot()]

    def restore(self, snapshots: list[Any], iteration: int) -> None:
        """Go on from a checkpoint, or start afresh where it holds no snapshot."""
        require_shards(snapshots, 1)
        if snapshots[0] is None:
            self.sampler.begin(restart_purpose(iteration))
        else:
            self.sampler.restore(snapshots[0])

    def process_ids(self) -> list[int]:
        """None: this process does the work."""
        return []

    def usage(self) -> Usage:
        """Nothing beside this process."""
        return Usage()

    def close(self) -> None:
        """Close the environment."""
        self.sampler.env.close()
