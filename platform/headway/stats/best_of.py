"""Expected best of n candidates of a hyper-parameter search."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from headway.stats.samples import as_sample


@dataclass(frozen=True, slots=True)
class BestOf:
    """The best score of n candidates, for n = 1 .. N: its mean and standard deviation, each of shape (N,)."""

    mean: NDArray[np.float64]
    std: NDArray[np.float64]


def expected_best(scores: ArrayLike, lower_is_better: bool = False) -> BestOf:
    """Return mean and standard deviation of the best of n candidates, for n = 1 .. N.

    `scores` (N,) holds one score per candidate. The n candidates are drawn from them with replacement: with
    the empirical distribution F, P(best = v) = F(v)^n - F(v-)^n for the maximum. Source: Dodge et al. 2019,
    "Show Your Work: Improved Reporting of Experimental Results", EMNLP, arXiv:1909.03004. At n close to N
    the estimate is too low on average, since a sample with replacement may miss the best score.

    Raises ValueError if there are no scores or one is not finite.
    """
    sample = as_sample(scores, "scores")
    sign = -1.0 if lower_is_better else 1.0
    values, counts = np.unique(sign * sample, return_counts=True)
    n = np.arange(1, len(sample) + 1)[:, None]
    at_most = np.cumsum(counts) / len(sample)
    probability = np.diff(at_most**n, axis=1, prepend=0.0)
    mean = probability @ values
    # Around the mean: the difference of E[v^2] and E[v]^2 would cancel for scores far from 0.
    variance = (probability * (values - mean[:, None]) ** 2).sum(axis=1)
    return BestOf(sign * mean, np.sqrt(variance))
