"""Statistics of scores over runs and tasks, with intervals by the stratified bootstrap.

`scores` holds one array per task (environment), over the runs of one algorithm; tasks may differ in their
number of runs. All definitions are those of rliable. Sources: Agarwal et al. 2021, "Deep RL at the Edge of
the Statistical Precipice", arXiv:2108.13264; Efron and Tibshirani 1993 (percentile intervals).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from headway.stats.samples import CONFIDENCE, Interval, as_sample

RESAMPLES = 10_000
"""Bootstrap resamples of a single statistic."""
BAND_RESAMPLES = 2_000
"""Bootstrap resamples of statistics along a curve, and of pairwise comparisons."""
_METHOD = "stratified bootstrap"
_SEED = 0
"""Seed of the resampling: equal scores have equal intervals."""


@dataclass(frozen=True, slots=True)
class Band:
    """Estimates along a curve with pointwise confidence intervals, each of shape (points,)."""

    estimate: NDArray[np.float64]
    low: NDArray[np.float64]
    high: NDArray[np.float64]


def interquartile_mean(scores: Sequence[ArrayLike]) -> Interval:
    """Return the interquartile mean of all scores with its percentile interval by the stratified bootstrap.

    Runs are drawn with replacement within each task (Agarwal et al. 2021). Raises ValueError if there are no
    tasks, or if a task has no scores or one that is not finite.
    """
    tasks = _tasks(scores, "scores")
    generator = np.random.default_rng(_SEED)
    drawn = [task[_draw(generator, len(task), RESAMPLES)] for task in tasks]
    estimate = float(_trimmed(np.concatenate(tasks)))
    low, high = _percentiles(_trimmed(np.concatenate(drawn, axis=-1)))
    return Interval(estimate, float(low), float(high), _METHOD)


def probability_of_improvement(
    a: Sequence[ArrayLike], b: Sequence[ArrayLike], resamples: int = BAND_RESAMPLES
) -> Interval:
    """Return the probability that a run of `a` scores above a run of `b`, averaged over tasks.

    Runs are compared on the same task, and ties count half (the Mann-Whitney statistic; Agarwal et al. 2021).
    For the percentile interval the runs of both are drawn with replacement within each task. Raises
    ValueError if the numbers of tasks differ, and for the reasons of `interquartile_mean`.
    """
    left, right = _tasks(a, "a"), _tasks(b, "b")
    if len(left) != len(right):
        raise ValueError(f"a has {len(left)} tasks and b has {len(right)}: both need the same tasks")
    generator = np.random.default_rng(_SEED)
    estimates, drawn = [], []
    for ours, theirs in zip(left, right, strict=True):
        # (runs of a, runs of b): 1 for a win of a, 0.5 for a tie, 0 for a loss.
        wins = (np.sign(ours[:, None] - theirs) + 1) / 2
        rows = _draw(generator, len(ours), resamples)
        columns = _draw(generator, len(theirs), resamples)
        estimates.append(wins.mean())
        drawn.append(wins[rows[:, :, None], columns[:, None, :]].mean(axis=(1, 2)))
    low, high = _percentiles(np.mean(drawn, axis=0))
    return Interval(float(np.mean(estimates)), float(low), float(high), _METHOD)


def performance_profile(scores: Sequence[ArrayLike], thresholds: ArrayLike) -> Band:
    """Return the share of runs that score above each of `thresholds` (points,), with pointwise intervals.

    This is the run-score distribution of Agarwal et al. 2021, with percentile intervals by the stratified
    bootstrap. Raises ValueError for the reasons of `interquartile_mean`.
    """
    tasks, points = _tasks(scores, "scores"), as_sample(thresholds, "thresholds")
    generator = np.random.default_rng(_SEED)
    drawn = [task[_draw(generator, len(task), BAND_RESAMPLES)] for task in tasks]
    everything, resampled = np.concatenate(tasks), np.concatenate(drawn, axis=-1)
    shares = np.stack([(resampled > point).mean(axis=-1) for point in points], axis=-1)
    low, high = _percentiles(shares)
    return Band((everything[:, None] > points).mean(axis=0), low, high)


def sample_efficiency(curves: Sequence[ArrayLike], resamples: int = BAND_RESAMPLES) -> Band:
    """Return the interquartile mean at each point of the curves, with pointwise percentile intervals.

    `curves` holds one array of shape (runs, points) per task. Whole runs are drawn with replacement within
    each task (Agarwal et al. 2021). Raises ValueError if the numbers of points differ, and for the reasons of
    `interquartile_mean`.
    """
    tasks = [as_sample(task, f"curves[{index}]", axes=2) for index, task in enumerate(curves)]
    if len({task.shape[1] for task in tasks}) != 1:
        raise ValueError("curves must hold at least one task, and all tasks the same number of points")
    generator = np.random.default_rng(_SEED)
    drawn = [_draw(generator, len(task), resamples) for task in tasks]
    everything = np.concatenate(tasks)
    # Point by point: all points at once would need resamples x runs x points numbers.
    resampled = np.stack(
        [
            _trimmed(
                np.concatenate([task[rows, point] for task, rows in zip(tasks, drawn, strict=True)], axis=-1)
            )
            for point in range(everything.shape[1])
        ],
        axis=-1,
    )
    low, high = _percentiles(resampled)
    return Band(_trimmed(everything.T), low, high)


def normalised(score: ArrayLike, random: float, best: float) -> NDArray[np.float64]:
    """Return (score - random) / (best - random), in the shape of `score`.

    It is comparable across environments: 0 is random play's return, 1 the best rule's. Raises ValueError if
    the best rule does not score above random play.
    """
    if not random < best:
        raise ValueError(f"the best rule ({best:g}) must score above random play ({random:g})")
    return (np.asarray(score, np.float64) - random) / (best - random)


def _trimmed(scores: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the interquartile mean along the last axis: a quarter, rounded down, is trimmed at each end."""
    count = scores.shape[-1]
    cut = count // 4
    middle: NDArray[np.float64] = np.sort(scores, axis=-1)[..., cut : count - cut].mean(axis=-1)
    return middle


def _tasks(scores: Sequence[ArrayLike], name: str) -> list[NDArray[np.float64]]:
    """Return each task's scores, checked; `name` is used in messages."""
    if not len(scores):
        raise ValueError(f"{name} must hold at least one task")
    return [as_sample(task, f"{name}[{index}]") for index, task in enumerate(scores)]


def _draw(generator: np.random.Generator, runs: int, resamples: int) -> NDArray[np.int64]:
    """Draw run indices with replacement, shape (resamples, runs)."""
    return generator.integers(0, runs, (resamples, runs))


def _percentiles(resampled: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the ends of the percentile interval along axis 0, the resamples."""
    low, high = np.quantile(resampled, [(1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2], axis=0)
    return low, high
