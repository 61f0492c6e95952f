"""95% intervals of means and of differences, by Student's t.

"A beats B" means a paired difference on common evaluation seeds whose 95% interval excludes 0. Source for the
sum of several variances: Banerjee 1961, "On confidence interval for two-means problem based on separate
estimates of variances and tabulated values of t-table", Sankhya A 23.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from headway.stats.samples import CONFIDENCE, Interval, as_sample


def paired_difference(a: ArrayLike, b: ArrayLike, confidence: float = CONFIDENCE) -> Interval:
    """Return the mean of a - b with its interval by Student's t over evaluation episodes.

    `a` and `b` have shape (episodes,), entry j from evaluation episode j. Raises ValueError for fewer than
    two episodes, different shapes, or values that are not finite.
    """
    mean, half = mean_and_half_width(_differences(a, b, 1), confidence)
    return Interval(float(mean), float(mean - half), float(mean + half), "t over episodes")


def mean_and_half_width(
    values: NDArray[np.float64], confidence: float = CONFIDENCE
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the mean over axis 0, of length at least 2, and its interval's half width by Student's t."""
    # The quantile of Student's t; scipy.stats takes thrice as long to import.
    from scipy.special import stdtrit

    count = len(values)
    error = values.std(axis=0, ddof=1) / np.sqrt(count)
    return values.mean(axis=0), stdtrit(count - 1, (1 + confidence) / 2) * error


def prediction_interval(values: ArrayLike, confidence: float) -> tuple[float, float]:
    """Return the interval in which a further value lies with probability `confidence`, by Student's t.

    `values`, of shape (values,), and the further one are independent draws from one normal distribution: mean
    +- t s sqrt(1 + 1/n). Raises ValueError for fewer than two values or values that are not finite.
    """
    from scipy.special import stdtrit

    sample = as_sample(values, "values")
    count = len(sample)
    if count < 2:
        raise ValueError("an interval needs two values")
    half = stdtrit(count - 1, (1 + confidence) / 2) * sample.std(ddof=1) * np.sqrt(1 + 1 / count)
    return float(sample.mean() - half), float(sample.mean() + half)


def paired_difference_over_seeds(a: ArrayLike, b: ArrayLike, confidence: float = CONFIDENCE) -> Interval:
    """Return the mean of a - b with an interval over both training seeds and evaluation episodes.

    `a` and `b` have shape (seeds, episodes), entry (i, j) from training seed i on evaluation episode j. The
    half width is the root of the sum of the squared half widths of Student's t over seeds and over episodes
    (Banerjee 1961).

    Why: all seeds are evaluated on the same episodes, so entries are not independent. With variances s2 of
    seeds, d2 of episodes and e2 of the rest, the mean over S seeds and D episodes has variance s2/S + d2/D +
    e2/(S D). The sample variances of the seeds' means and of the episodes' means estimate s2 + e2/D and d2 +
    e2/S, independently of each other. For normal effects this interval contains the true mean at least as
    often as stated, whatever share of the variance each part has. A single t with pooled degrees of freedom
    (Satterthwaite) contains it too rarely with two seeds, as does the bootstrap over both axes with few seeds
    or episodes.

    Limits: the interval is somewhat too wide, since e2/(S D) counts twice, and with two seeds t is 12.7
    standard errors. It cannot account for failures that did not occur: if one seed in four fails, five seeds
    are often all good, and in simulation only three intervals in four contained the true value.

    Raises ValueError for fewer than two seeds or two episodes, different shapes, or values not finite.
    """
    difference = _differences(a, b, 2)
    mean = float(difference.mean())
    _, of_seeds = mean_and_half_width(difference.mean(axis=1), confidence)
    _, of_episodes = mean_and_half_width(difference.mean(axis=0), confidence)
    half = float(np.hypot(of_seeds, of_episodes))
    return Interval(mean, mean - half, mean + half, "t over seeds and episodes")


def difference_of_means(a: ArrayLike, b: ArrayLike) -> Interval:
    """Return the mean of `a` minus the mean of `b` with its interval by Welch's t, for unpaired seeds.

    `a` and `b` hold one value per seed, shapes (seeds of a,) and (seeds of b,); their variances may differ.
    If neither varies, the ends of the interval are NaN. Source: Welch 1947, "The generalization of Student's
    problem when several different population variances are involved", Biometrika 34.

    Raises ValueError for fewer than two seeds of either, or values that are not finite.
    """
    from scipy import stats

    left, right = as_sample(a, "a"), as_sample(b, "b")
    if min(len(left), len(right)) < 2:
        raise ValueError("an interval needs at least two seeds of each")
    estimate, low, high = float(left.mean() - right.mean()), float("nan"), float("nan")
    if np.ptp(left) > 0 or np.ptp(right) > 0:
        found = stats.ttest_ind(left, right, equal_var=False).confidence_interval(CONFIDENCE)
        low, high = float(found.low), float(found.high)
    return Interval(estimate, low, high, "Welch's t over seeds")


def _differences(a: ArrayLike, b: ArrayLike, axes: int) -> NDArray[np.float64]:
    """Return a - b, checked for shape, size and finite values."""
    left, right = np.asarray(a, np.float64), np.asarray(b, np.float64)
    if left.shape != right.shape or left.ndim != axes:
        raise ValueError(f"a {left.shape} and b {right.shape} must have the same shape, of {axes} axes")
    if min(left.shape) < 2:
        raise ValueError(
            f"an interval needs at least two {'episodes' if axes == 1 else 'seeds and two episodes'}"
        )
    difference: NDArray[np.float64] = left - right
    if not np.isfinite(difference).all():
        raise ValueError("a and b must be finite")
    return difference
