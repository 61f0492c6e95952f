"""Evaluation in separate processes, for environments that limit the copies per process."""

from typing import Any

from headway.contracts.acting_policy import Parameters
from headway.events import Row, Usage
from headway.rollout.collector import Collector
from headway.rollout.sampler import Episode


class SeparateEvaluation:
    """A collector that samples with one collector and evaluates with another.

    The evaluating collector never begins training episodes.
    """

    def __init__(self, training: Collector, evaluator: Collector) -> None:
        self.training, self.evaluator = training, evaluator
        self.trajectory = training.trajectory

    def begin(self) -> None:
        """Start the first episodes."""
        self.training.begin()

    def collect(self, iteration: int, parameters: Parameters) -> list[Episode]:
        """Sample one iteration."""
        return self.training.collect(iteration, parameters)

    def evaluate(self, root: int, episodes: int, greedy: bool, parameters: Parameters) -> list[list[Row]]:
        """Play evaluation episodes in the evaluating collector."""
        return self.evaluator.evaluate(root, episodes, greedy, parameters)

    def snapshot(self) -> list[Any]:
        """Return the snapshots of the training collector's shards."""
        return self.training.snapshot()

    def restore(self, snapshots: list[Any], iteration: int) -> None:
        """Continue from a checkpoint."""
        self.training.restore(snapshots, iteration)

    def process_ids(self) -> list[int]:
        """Return the worker processes of both collectors."""
        return self.training.process_ids() + self.evaluator.process_ids()

    def usage(self) -> Usage:
        """Return the usage of both collectors."""
        return self.training.usage() + self.evaluator.usage()

    def close(self) -> None:
        """Close both collectors."""
        try:
            self.training.close()
        finally:
            self.evaluator.close()
