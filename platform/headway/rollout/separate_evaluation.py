"""Evaluation in processes of its own, for environments of which a process may hold few copies."""

from typing import Any

from headway.contracts.acting_policy import Parameters
from headway.events import Row, Usage
from headway.rollout.collector import Collector
from headway.rollout.sampler import Episode


class SeparateEvaluation:
    """Trains with one collector and evaluates with another, which is never begun."""

    def __init__(self, training: Collector, evaluating: Collector) -> None:
        self.training, self.evaluating = training, evaluating
        self.trajectory = training.trajectory

    def begin(self) -> None:
        """Start the first episodes."""
        self.training.begin()

    def collect(self, iteration: int, parameters: Parameters) -> list[Episode]:
        """Sample one iteration."""
        return self.training.collect(iteration, parameters)

    def evaluate(self, root: int, episodes: int, greedy: bool, parameters: Parameters) -> list[list[Row]]:
        """Evaluation episodes, elsewhere."""
        return self.evaluating.evaluate(root, episodes, greedy, parameters)

    def snapshot(self) -> list[Any]:
        """Training's."""
        return self.training.snapshot()

    def restore(self, snapshots: list[Any], iteration: int) -> None:
        """Go on from a checkpoint."""
        self.training.restore(snapshots, iteration)

    def process_ids(self) -> list[int]:
        """Workers of both."""
        return self.training.process_ids() + self.evaluating.process_ids()

    def usage(self) -> Usage:
        """Of both."""
        return self.training.usage() + self.evaluating.usage()

    def close(self) -> None:
        """End both."""
        try:
            self.training.close()
        finally:
            self.evaluating.close()
