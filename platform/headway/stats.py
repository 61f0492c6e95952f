"""Figures of a run, over seeds, and of one algorithm against another.

"A beats B" means a paired difference on common evaluation seeds whose 95% interval excludes 0.
Sources: Agarwal et al. 2021, "Deep RL at the Edge of the Statistical Precipice", arXiv:2108.13264 (the
interquartile mean and the stratified bootstrap); Efron and Tibshirani 1993 (percentile intervals);
Banerjee 1961, "On confidence interval for two-means problem based on separate estimates of variances and
tabulated values of t-table", Sankhya A 23 (adding intervals of several variances).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

FINAL_SHARE = 0.2
"""Share of the curve's steps over which the final reward is taken."""
RESAMPLES = 10_000

Statistic = Callable[[NDArray[np.float64]], NDArray[np.float64]]
"""From (..., runs) to (...), over the last axis."""


@dataclass(frozen=True, slots=True)
class MeanStd:
    """A mean over seeds, with the sample standard deviation (ddof = 1; NaN for one seed)."""

    mean: float
    std: float
    count: int


@dataclass(frozen=True, slots=True)
class Interval:
    """An estimate with its confidence interval."""

    estimate: float
    low: float
    high: float
    confidence: float
    method: str
    """How it was made, and over what: `t over days`."""

    @property
    def excludes_zero(self) -> bool:
        """The interval lies wholly on one side of 0."""
        return self.low > 0 or self.high < 0


def final_reward(env_steps: ArrayLike, values: ArrayLike) -> float:
    """Mean of the values over the last 20% of the curve's steps (the last value always counts).

    Both of shape (points,), steps increasing. Raises ValueError for a curve that is empty or not so.
    """
    steps, curve = _curve(env_steps, values)
    start = steps[-1] - FINAL_SHARE * (steps[-1] - steps[0])
    return float(curve[steps >= start].mean())


def auc(
    env_steps: ArrayLike, values: ArrayLike, low: float | None = None, high: float | None = None
) -> float:
    """Area under the min-max-normalised curve over its span of steps, by the trapezoid rule: 0 to 1.

    Without bounds, the curve's own extremes are 0 and 1 (per-run normalisation, as published; it says how
    early a run learns, not how well). With study-wide bounds `low` and `high`, runs may be ranked, and
    values outside count as they are. A flat curve has no shape: with its own extremes its area is
    0.5 by definition. A curve of one point has the area of its normalised value.

    Raises ValueError for a curve that is empty or unordered, one bound alone, or `low` not below `high`.
    """
    steps, curve = _curve(env_steps, values)
    if (low is None) != (high is None):
        raise ValueError("give both low and high, or neither")
    if low is None or high is None:
        low, high = float(curve.min()), float(curve.max())
        if low == high:
            return 0.5
    elif not low < high:
        raise ValueError(f"low {low} must be below high {high}")
    scaled = (curve - low) / (high - low)
    if len(steps) == 1:
        return float(scaled[0])
    return float(np.trapezoid(scaled, steps) / (steps[-1] - steps[0]))


def mean_std(values: ArrayLike) -> MeanStd:
    """Mean and sample standard deviation (ddof = 1) of one figure a seed, shape (seeds,).

    Raises ValueError if there is none.
    """
    sample = _sample(values, "values")
    std = float(sample.std(ddof=1)) if len(sample) > 1 else float("nan")
    return MeanStd(float(sample.mean()), std, len(sample))


def interquartile_mean(scores: ArrayLike) -> float:
    """Mean of the middle half of all scores, of any shape: a quarter is trimmed at each end, rounded down
    (Agarwal et al. 2021; `scipy.stats.trim_mean` with 0.25). Raises ValueError if there is none."""
    return float(_trimmed(_sample(np.ravel(scores), "scores")))


def paired_difference(a: ArrayLike, b: ArrayLike, confidence: float = 0.95) -> Interval:
    """Mean of a - b with its interval by Student's t over days; both of shape (days,), entry j made on
    evaluation day j.

    Raises ValueError for fewer than two days, shapes that differ, or a confidence not within 0 and 1.
    """
    mean, half = mean_and_half_width(_differences(a, b, 1), confidence)
    return Interval(float(mean), float(mean - half), float(mean + half), confidence, "t over days")


def mean_and_half_width(
    values: NDArray[np.float64], confidence: float = 0.95
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Mean over axis 0, of at least two, and the half width of its interval by Student's t.

    Raises ValueError for a confidence not within 0 and 1.
    """
    from scipy import stats  # a third of a second: paid only by who compares

    _check_confidence(confidence)
    count = len(values)
    error = values.std(axis=0, ddof=1) / np.sqrt(count)
    return values.mean(axis=0), stats.t.ppf((1 + confidence) / 2, count - 1) * error


def paired_difference_over_seeds(a: ArrayLike, b: ArrayLike, confidence: float = 0.95) -> Interval:
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


def stratified_bootstrap_interval(
    scores: Sequence[ArrayLike],
    statistic: Statistic | None = None,
    confidence: float = 0.95,
    resamples: int = RESAMPLES,
    seed: int = 0,
) -> Interval:
    """A statistic over all scores (default: the interquartile mean) with its percentile interval by the
    stratified bootstrap: runs are drawn with replacement within each task (Agarwal et al. 2021).

    `scores` holds one array of shape (runs,) a task; tasks may differ in runs. `statistic` maps
    (..., scores) to (...). Raises ValueError if a task has no scores or `confidence` is not within 0 and 1.
    """
    _check_confidence(confidence)
    if not len(scores):
        raise ValueError("scores must hold at least one task")
    tasks = [_sample(task, f"scores[{index}]") for index, task in enumerate(scores)]
    evaluate = statistic or _trimmed
    generator = np.random.default_rng(seed)
    drawn = [task[generator.integers(0, len(task), (resamples, len(task)))] for task in tasks]
    estimate = float(evaluate(np.concatenate(tasks)))
    return _percentile(estimate, evaluate(np.concatenate(drawn, axis=-1)), confidence)


def _trimmed(scores: NDArray[np.float64]) -> NDArray[np.float64]:
    count = scores.shape[-1]
    cut = count // 4
    middle: NDArray[np.float64] = np.sort(scores, axis=-1)[..., cut : count - cut].mean(axis=-1)
    return middle


def _percentile(estimate: float, resampled: NDArray[np.float64], confidence: float) -> Interval:
    low, high = np.quantile(resampled, [(1 - confidence) / 2, (1 + confidence) / 2])
    return Interval(estimate, float(low), float(high), confidence, "stratified bootstrap")


def _curve(env_steps: ArrayLike, values: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    steps, curve = _sample(env_steps, "env_steps"), _sample(values, "values")
    if steps.shape != curve.shape:
        raise ValueError(f"env_steps has {len(steps)} points and values has {len(curve)}: give as many")
    if np.any(np.diff(steps) <= 0):
        raise ValueError("env_steps must increase from point to point")
    return steps, curve


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


def _sample(values: ArrayLike, name: str) -> NDArray[np.float64]:
    sample = np.asarray(values, np.float64)
    if sample.ndim != 1 or not sample.size:
        raise ValueError(f"{name} must be a row of at least one number, not of shape {sample.shape}")
    if not np.isfinite(sample).all():
        raise ValueError(f"{name} must be finite")
    return sample


def _check_confidence(confidence: float) -> None:
    if not 0 < confidence < 1:
        raise ValueError(f"confidence {confidence} must be between 0 and 1")
