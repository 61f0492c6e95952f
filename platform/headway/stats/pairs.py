"""Differences between two learners: interval, p-value, correction for several pairs, and seeds needed.

Sources: Banerjee 1961 (see `headway.stats.intervals`); Holm 1979, "A simple sequentially rejective multiple
test procedure", Scandinavian Journal of Statistics 6; Colas et al. 2018, "How Many Random Seeds? Statistical
Power Analysis in Deep Reinforcement Learning Experiments", arXiv:1806.08295.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from headway.stats.samples import CONFIDENCE, Interval, as_sample

POWER = 0.8
"""Probability with which `LearnerDifference.seeds_needed` seeds show a difference."""
MOST_SEEDS = 1_000
"""Maximum number of seeds that `LearnerDifference.seeds_needed` tries."""
_SMALLEST_P = 1e-15
_DRAWS, _SEED = 4_000, 0
"""Draws of the variances from which a power is computed, and their seed."""


@dataclass(frozen=True, slots=True)
class LearnerDifference:
    """Mean difference of two learners, a - b, whose policies played the same episodes.

    Training seeds are independent between the learners, also where their numbers are equal; episodes are
    paired. The squared half width of the interval is the sum of the squared half widths of Student's t over
    the seeds of `a`, over the seeds of `b`, and over episodes (Banerjee 1961), for the reasons given at
    `intervals.paired_difference_over_seeds`. If either learner has a single seed, the variation between seeds
    is unknown and the interval is over episodes alone.
    """

    estimate: float
    seeds: tuple[int, int]
    """Numbers of training seeds of a and b."""
    episodes: int
    seed_variances: tuple[float, float]
    """Sample variance of the seeds' means, of a and b; NaN for one seed."""
    episode_variance: float
    """Sample variance of the episodes' mean differences."""
    residual_variances: tuple[float, float]
    """Variance of single values that neither seeds nor episodes explain, of a and b; NaN for one seed."""

    @classmethod
    def of(cls, a: ArrayLike, b: ArrayLike) -> "LearnerDifference":
        """Return the difference of `a` and `b`, shapes (seeds of each, episodes); column j is episode j.

        Raises ValueError for fewer than two episodes, different numbers of episodes, or values not finite.
        """
        left, right = as_sample(a, "a", axes=2), as_sample(b, "b", axes=2)
        if left.shape[1] != right.shape[1] or left.shape[1] < 2:
            raise ValueError(f"a {left.shape} and b {right.shape} need the same episodes, at least two")
        by_episode = left.mean(axis=0) - right.mean(axis=0)
        return cls(
            float(by_episode.mean()),
            (len(left), len(right)),
            left.shape[1],
            (_variance(left.mean(axis=1)), _variance(right.mean(axis=1))),
            _variance(by_episode),
            (_residual_variance(left), _residual_variance(right)),
        )

    @property
    def several_seeds(self) -> bool:
        """Whether both learners have several seeds, whose variation the interval then includes."""
        return min(self.seeds) > 1

    @property
    def interval(self) -> Interval:
        """The difference with its 95% interval."""
        half = self._half_width(1 - CONFIDENCE)
        method = "t over seeds and episodes" if self.several_seeds else "t over episodes"
        return Interval(self.estimate, self.estimate - half, self.estimate + half, method)

    @property
    def p_value(self) -> float:
        """Smallest p for which the interval of confidence 1 - p excludes 0."""
        from scipy.optimize import brentq

        size = abs(self.estimate)
        if size == 0.0:
            return 1.0
        if self._half_width(_SMALLEST_P) < size:
            return _SMALLEST_P if self._half_width(_SMALLEST_P) > 0 else 0.0
        logarithm = brentq(lambda log_p: self._half_width(np.exp(log_p)) - size, np.log(_SMALLEST_P), 0.0)
        return float(np.exp(logarithm))

    def power(self, seeds: int, significance: float = 1 - CONFIDENCE) -> float:
        """Return the probability that the interval of as many episodes and `seeds` seeds per learner, of
        confidence 1 - `significance`, excludes 0.

        True difference and variances are taken to be the observed ones, and effects of seeds and episodes to
        be normal, as Colas et al. 2018 do for Welch's t. The mean is taken over draws of the variances that
        such an experiment would estimate. NaN if a learner has one seed.
        """
        from scipy.special import ndtr, stdtrit

        if not self.several_seeds:
            return float("nan")
        residual = np.array(self.residual_variances)
        of_episodes = max(self.episode_variance - float((residual / self.seeds).sum()), 0.0)
        of_seeds = np.array(self.seed_variances) / seeds
        deviation = np.sqrt(of_seeds.sum() + of_episodes / self.episodes)
        generator = np.random.default_rng(_SEED)
        drawn = generator.chisquare(seeds - 1, (2, _DRAWS)) / (seeds - 1)
        drawn_episodes = generator.chisquare(self.episodes - 1, _DRAWS) / (self.episodes - 1)
        over_seeds = stdtrit(seeds - 1, 1 - significance / 2) ** 2 * (of_seeds @ drawn)
        mean_differences = (of_episodes + residual.sum() / seeds) / self.episodes * drawn_episodes
        over_episodes = stdtrit(self.episodes - 1, 1 - significance / 2) ** 2 * mean_differences
        half, size = np.sqrt(over_seeds + over_episodes), abs(self.estimate)
        if deviation == 0.0:
            return float(np.mean(size > half))
        return float(np.mean(ndtr((size - half) / deviation) + ndtr((-size - half) / deviation)))

    def seeds_needed(self, significance: float = 1 - CONFIDENCE) -> float:
        """Return the smallest number of seeds per learner, at least two, whose `power` is `POWER`.

        It is infinite if `MOST_SEEDS` are not enough, as when the difference is too small for the number of
        episodes, and NaN if a learner has one seed.
        """
        if not self.several_seeds:
            return float("nan")
        if self.power(MOST_SEEDS, significance) < POWER:
            return float("inf")
        too_few, enough = 1, MOST_SEEDS
        while enough - too_few > 1:
            middle = (too_few + enough) // 2
            if self.power(middle, significance) < POWER:
                too_few = middle
            else:
                enough = middle
        return float(enough)

    def _half_width(self, p: float) -> float:
        """Return the half width of the interval of confidence 1 - p."""
        from scipy.special import stdtrit

        parts = [(self.episode_variance, self.episodes)]
        if self.several_seeds:
            parts += zip(self.seed_variances, self.seeds, strict=True)
        # The lower tail, which is exact for small p too.
        return float(np.sqrt(sum(stdtrit(count - 1, p / 2) ** 2 * value / count for value, count in parts)))


def holm(p_values: ArrayLike) -> NDArray[np.float64]:
    """Return p-values (tests,) adjusted for the number of tests by Holm 1979.

    Rejecting each hypothesis whose adjusted p is below 5% rejects any true one with a probability of at most
    5%, whatever the dependence of the tests.
    """
    values = np.asarray(p_values, np.float64)
    order = np.argsort(values, kind="stable")
    steps = np.maximum.accumulate(values[order] * np.arange(len(values), 0, -1))
    adjusted = np.empty_like(values)
    adjusted[order] = np.minimum(steps, 1.0)
    return adjusted


class PairRow(NamedTuple):
    """One metric of two learners on the same episodes."""

    metric: str
    a: str
    b: str
    difference: LearnerDifference
    """a minus b."""
    corrected_p: float
    """Its p-value, corrected by Holm for the number of pairs."""
    seeds_needed: float
    """See `LearnerDifference.seeds_needed`, with the significance of one of as many tests as pairs."""


def pair_rows(
    metric: str,
    learners: Mapping[str, Sequence[Sequence[float]]],
    pairs: Iterable[tuple[str, str]],
) -> list[PairRow]:
    """Compare pairs of `learners`, each with its values of a metric (seeds x episodes); the pairs are one
    family of hypotheses."""
    found = {(a, b): LearnerDifference.of(learners[a], learners[b]) for a, b in pairs}
    corrected = holm([each.p_value for each in found.values()])
    significance = (1 - CONFIDENCE) / max(len(found), 1)
    return [
        PairRow(metric, *pair, each, float(p_value), each.seeds_needed(significance))
        for (pair, each), p_value in zip(found.items(), corrected, strict=True)
    ]


def _variance(values: NDArray[np.float64]) -> float:
    return float(values.var(ddof=1)) if len(values) > 1 else float("nan")


def _residual_variance(values: NDArray[np.float64]) -> float:
    """Return the mean square of the residuals of a two-way layout (seeds, episodes)."""
    seeds, episodes = values.shape
    if seeds < 2:
        return float("nan")
    effects = values.mean(axis=0) + values.mean(axis=1, keepdims=True) - values.mean()
    return float(((values - effects) ** 2).sum() / ((seeds - 1) * (episodes - 1)))
