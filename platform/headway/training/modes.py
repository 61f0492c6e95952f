"""Training modes: synchronous (sample, then learn) and asynchronous (apply contributions as they arrive)."""

import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from headway.config.experiment import StartConfig
from headway.contracts import AnchoredLearner, AsynchronousLearner, Learner, StartingLearner
from headway.rollout.collector import Collector, Contributors
from headway.rollout.sampler import Episode, sort_episodes
from headway.rollout.workers.worker import Contribute


@dataclass(frozen=True)
class IterationResult:
    """Episodes, metrics and times of one iteration."""

    episodes: list[Episode]
    """Training episodes that ended, by replica, copy and time."""
    metrics: Mapping[str, NDArray[np.float64]]
    """Metrics by `group/name`, each of shape (R,)."""
    collect_s: float
    """Seconds spent sampling or waiting for workers."""
    learn_s: float
    """Seconds spent learning."""


class Mode(Protocol):
    """How workers and learner work together in an iteration."""

    deterministic: bool
    """Rerunning or resuming reproduces the run exactly."""

    def iterate(self, iteration: int, progress: float) -> IterationResult:
        """Run one iteration, numbered from 1; `progress` is the share of the budget used before it."""
        ...


class SynchronousMode:
    """All workers sample, then the learner learns from the whole trajectory."""

    deterministic = True

    def __init__(
        self,
        learner: Learner,
        collector: Collector,
        rule_iterations: int,
        start: StartConfig,
        iterations: int,
    ) -> None:
        """A rule acts in the first `rule_iterations` of `iterations`, and a `StartingLearner` imitates it.

        If `start` asks for it, an `AnchoredLearner` then stays near its first policies.
        """
        self.learner, self.collector = learner, collector
        self.rule_iterations, self.start = rule_iterations, start
        self.learning_share = 1 - rule_iterations / iterations

    def iterate(self, iteration: int, progress: float) -> IterationResult:
        """Sample one iteration and learn from it."""
        began = time.monotonic()
        parameters = self.learner.acting_parameters()
        episodes = self.collector.collect(iteration, parameters)
        collected = time.monotonic()
        trajectory = self.collector.trajectory
        if iteration <= self.rule_iterations:
            assert isinstance(self.learner, StartingLearner)
            metrics = self.learner.imitate(trajectory, iteration, self.rule_iterations)
        else:
            self._anchor(iteration, progress)
            metrics = self.learner.update(trajectory, iteration, progress)
        return IterationResult(episodes, metrics, collected - began, time.monotonic() - collected)

    def _anchor(self, iteration: int, progress: float) -> None:
        if not self.start.anchors:
            return
        assert isinstance(self.learner, AnchoredLearner)
        # The coefficient falls from the first iteration of learning, not of the rule, to the end.
        kl_coeff = self.start.kl_coeff * (1 - progress) / self.learning_share
        self.learner.anchor(kl_coeff, iteration <= self.rule_iterations + self.start.critic_iterations)


class AsynchronousMode:
    """Asynchronous training as in A3C (Mnih et al. 2016, arXiv:1602.01783).

    Each worker samples and computes a contribution (gradients, for instance); the learner applies it on
    arrival and sends the worker the updated parameters. Workers never wait for each other: an iteration ends
    when as many contributions as there are workers have been applied. They do wait for the learner while it
    applies other contributions, evaluates, writes a checkpoint or replaces a worker. No contribution beyond
    the budget is assigned.

    A contribution's staleness is the number of updates made since its parameters were published. Every
    iteration reports `staleness/mean` and `staleness/max`.
    """

    def __init__(self, learner: AsynchronousLearner, contributors: Contributors, iterations: int) -> None:
        """`iterations` is the budget, after which no more tasks are assigned."""
        self.learner, self.contributors = learner, contributors
        self.budget = iterations * contributors.number
        """Contributions of the whole run."""
        self.deterministic = learner.in_turns or contributors.in_turns

    def iterate(self, iteration: int, progress: float) -> IterationResult:
        """Apply as many contributions as there are workers; metrics are means over these contributions."""
        start, learn_s, workers = time.monotonic(), 0.0, self.contributors.number
        before = (iteration - 1) * workers
        # Workers have no task in the first iteration, and after a resume without snapshots.
        for worker in range(workers):
            if worker not in self.contributors.tasks:
                self._assign(worker, before)
        episodes: list[Episode] = []
        staleness: list[int] = []
        metrics: list[Mapping[str, NDArray[np.float64]]] = []
        for turn in range(workers):
            worker, task, done = self.contributors.next_done(turn if self.learner.in_turns else None)
            arrived = time.monotonic()
            assert done.contribution is not None
            self.learner.apply(done.contribution, iteration, progress)
            # At once, so that the worker samples while the learner waits for the others.
            self._assign(worker, before + turn + 1)
            staleness.append(before + turn - task.updates)
            metrics.append(done.contribution.metrics)
            episodes += done.episodes
            learn_s += time.monotonic() - arrived
        means = {name: np.mean([each[name] for each in metrics], axis=0) for name in metrics[0]}
        replicas = len(next(iter(means.values())))
        means["staleness/mean"] = np.full(replicas, np.mean(staleness))
        means["staleness/max"] = np.full(replicas, float(max(staleness)))
        return IterationResult(sort_episodes(episodes), means, time.monotonic() - start - learn_s, learn_s)

    def _assign(self, worker: int, updates: int) -> None:
        """Assign a worker the next contribution within the budget, with the parameters after `updates`."""
        assigned = updates + len(self.contributors.tasks)
        if assigned < self.budget:
            task = Contribute(assigned + 1, updates, self.learner.published())
            self.contributors.assign(worker, task)
