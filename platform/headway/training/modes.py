"""How an iteration comes about: in step, workers and learner by turns; or asynchronously."""

import math
import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from headway.contracts import AsynchronousLearner, Learner
from headway.rollout.collector import Collector, Contributors
from headway.rollout.sampler import Episode, in_order
from headway.rollout.workers.worker import Contribute


@dataclass(frozen=True)
class IterationResult:
    """What an iteration brought."""

    episodes: list[Episode]
    """Those that ended in it, by replica, copy and time."""
    metrics: Mapping[str, NDArray[np.float64]]
    """By `group/name`, each (R,)."""
    collect_s: float
    learn_s: float


class Mode(Protocol):
    """Makes one iteration after another."""

    repeats: bool
    """The same again, and what is resumed, is the same."""

    def iterate(self, iteration: int, progress: float) -> IterationResult:
        """The iteration of that number, from 1, when `progress` of the budget is used."""
        ...


class SynchronousMode:
    """Workers sample, then the learner learns from all that they sampled."""

    repeats = True

    def __init__(self, learner: Learner, collector: Collector) -> None:
        self.learner, self.collector = learner, collector

    def iterate(self, iteration: int, progress: float) -> IterationResult:
        """See `Mode`."""
        began = time.monotonic()
        parameters = self.learner.acting_parameters()
        episodes = self.collector.collect(iteration, parameters)
        collected = time.monotonic()
        metrics = self.learner.update(self.collector.trajectory, iteration, progress)
        return IterationResult(episodes, metrics, collected - began, time.monotonic() - collected)


class AsynchronousMode:
    """Workers sample and find gradients by themselves; the learner applies each as it comes and gives its
    worker the parameters that it led to. No worker waits for another, also not where an iteration ends: that
    is when as many contributions were applied as there are workers. What a worker does wait for, once it has
    contributed, is the learner: while that applies others' contributions, evaluates (in one process beside
    the workers), writes a checkpoint, or starts a process for a worker that died. In the last iteration those
    that have contributed all that the budget holds are done.

    A contribution's staleness is the number of updates since its parameters were given out:
    `staleness/mean` and `staleness/max` of an iteration.
    """

    def __init__(
        self, learner: AsynchronousLearner, contributors: Contributors, iterations: int | None = None
    ) -> None:
        """`iterations`: of the budget, beyond which nobody is given anything to do; None: without end."""
        self.learner, self.contributors = learner, contributors
        self.budget = math.inf if iterations is None else iterations * contributors.number
        """Contributions in all."""
        self.repeats = learner.in_turns or contributors.in_turns

    def iterate(self, iteration: int, progress: float) -> IterationResult:
        """See `Mode`. All other metrics are means over the iteration's contributions."""
        began, learn_s, workers = time.monotonic(), 0.0, self.contributors.number
        before = (iteration - 1) * workers
        # At first, and where a resumed run's episodes start anew.
        for worker in self.contributors.idle():
            self._assign(worker, before)
        episodes: list[Episode] = []
        staleness: list[int] = []
        metrics: list[Mapping[str, NDArray[np.float64]]] = []
        for turn in range(workers):
            worker, task, done = self.contributors.next_done(turn if self.learner.in_turns else None)
            came = time.monotonic()
            assert done.contribution is not None
            self.learner.apply(done.contribution, iteration, progress)
            self._assign(worker, before + turn + 1)
            staleness.append(before + turn - task.updates)
            metrics.append(done.contribution.metrics)
            episodes += done.episodes
            learn_s += time.monotonic() - came
        means = {name: np.mean([each[name] for each in metrics], axis=0) for name in metrics[0]}
        replicas = len(next(iter(means.values())))
        means["staleness/mean"] = np.full(replicas, np.mean(staleness))
        means["staleness/max"] = np.full(replicas, float(max(staleness)))
        return IterationResult(in_order(episodes), means, time.monotonic() - began - learn_s, learn_s)

    def _assign(self, worker: int, updates: int) -> None:
        """Give a worker the parameters of the moment, after so many updates, unless all that the budget
        takes were given out."""
        given_out = updates + self.contributors.number - len(self.contributors.idle())
        if given_out < self.budget:
            task = Contribute(given_out + 1, updates, self.learner.published())
            self.contributors.assign(worker, task)
