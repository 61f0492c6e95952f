"""Intervals of means and of paired differences, by Student's t.

"A beats B" means a paired difference on common evaluation seeds whose 95% interval excludes 0.
Source: Banerjee 1961, "On confidence interval for two-means problem based on separate estimates of variances
and tabulated values of t-table", Sankhya A 23 (adding intervals of several variances).
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from headway.stats.samples import CONFIDENCE, Interval, check_confidence, sample_of


def paired_difference(a: ArrayLike, b: ArrayLike, confidence: float = CONFIDENCE) -> Interval:
    """Mean of a - b with its interval by Student's t over days; both of shape (days,), entry j made on
    evaluation day j.

    Raises ValueError for fewer than two days, shapes that differ, or a confidence not within 0 and 1.
    """
    mean, half = mean_and_half_width(_differences(a, b, 1), confidence)
    return Interval(float(mean), float(mean - half), float(mean + half), confidence, "t over days")


def mean_and_half_width(
    values: NDArray[np.float64], confidence: float = CONFIDENCE
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Mean over axis 0, of at least two, and the half width of its interval by Student's t.

    Raises ValueError for a confidence not within 0 and 1.
    """
    from scipy import stats  # a third of a second: paid only by who compares

    check_confidence(confidence)
    count = len(values)
    error = values.std(axis=0, ddof=1) / np.sqrt(count)
    return values.mean(axis=0), stats.t.ppf((1 + confidence) / 2, count - 1) * error


def paired_difference_over_seeds(a: ArrayLike, b: ArrayLike, confidence: float = CONFIDENCE) -> Interval:
    """Mean of a - b with an interval over training seeds and days both: each of shape (seeds, days), entry
    (i, j) made by training seed i on evaluation day j.

    The days are common to all seeds, so entries are not independent: with seeds, days and what is left of
    variance s2, d2 and e2, the mean of S seeds and D days has variance s2/S + d2/D + e2/(S D). The sample
    variances of the seeds' means and of the days' means estimate s2 + e2/D and d2 + e2/S, independently of
    each other. The squared half widths of Student's t over seeds and over days are added (Banerjee 1961):
    for normal effects that covers at least as often as it says whatever share of the variance each has, where
    one t of pooled degrees of freedom (Satterthwaite) covers too rarely with two seeds, and the bootstrap of
    both axes with few of either. It is somewhat too wide: e2/(S D) counts twice, and two seeds alone give
    12.7 standard errors. It cannot know what it has not seen: where one seed in four fails, five seeds are
    often all good, and in simulation three intervals in four held the truth.

    Raises ValueError as `paired_difference`, and for fewer than two seeds.
    """
    difference = _differences(a, b, 2)
    mean = float(difference.mean())
    _, of_seeds = mean_and_half_width(difference.mean(axis=1), confidence)
    _, of_days = mean_and_half_width(difference.mean(axis=0), confidence)
    half = float(np.hypot(of_seeds, of_days))
    return Interval(mean, mean - half, mean + half, confidence, "t over seeds and days")


def difference_of_means(a: ArrayLike, b: ArrayLike, confidence: float = CONFIDENCE) -> Interval:
    """Mean of a minus mean of b with its interval by Welch's t, which lets variances differ: one figure a
    seed each, shapes (seeds a,) and (seeds b,), that nothing pairs. Where neither varies there is nothing to
    tell an interval from: its ends are NaN.

    Source: Welch 1947, "The generalization of Student's problem when several different population variances
    are involved", Biometrika 34. Raises ValueError for fewer than two seeds of either, what is not finite, or
    a confidence not within 0 and 1.
    """
    from scipy import stats

    check_confidence(confidence)
    left, right = sample_of(a, "a"), sample_of(b, "b")
    if min(len(left), len(right)) < 2:
        raise ValueError("an interval needs at least two seeds of each")
    estimate, low, high = float(left.mean() - right.mean()), float("nan"), float("nan")
    if np.ptp(left) > 0 or np.ptp(right) > 0:
        found = stats.ttest_ind(left, right, equal_var=False).confidence_interval(confidence)
        low, high = float(found.low), float(found.high)
    return Interval(estimate, low, high, confidence, "Welch's t over seeds")


def _differences(a: ArrayLike, b: ArrayLike, axes: int) -> NDArray[np.float64]:
    left, right = np.asarray(a, np.float64), np.asarray(b, np.float64)
    if left.shape != right.shape or left.ndim != axes:
        raise ValueError(f"a {left.shape} and b {right.shape} must have the same shape, of {axes} axes")
    if min(left.shape) < 2:
        raise ValueError(f"an interval needs at least two {'days' if axes == 1 else 'seeds and two days'}")
    difference: NDArray[np.float64] = left - right
    if not np.isfinite(difference).all():
        raise ValueError("a and b must be finite")
    return difference
