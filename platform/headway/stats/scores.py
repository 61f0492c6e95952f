"""Statistics of scores over runs and tasks, with intervals by the stratified bootstrap.

`scores` holds one array a task (an environment), each over the runs of one algorithm; tasks may differ in
runs. All are rliable's definitions. Sources: Agarwal et al. 2021, "Deep RL at the Edge of the Statistical
Precipice", arXiv:2108.13264; Efron and Tibshirani 1993 (percentile intervals).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from headway.stats.samples import CONFIDENCE, Interval, check_confidence, sample_of

RESAMPLES = 10_000
BAND_RESAMPLES = 2_000
"""Of a whole curve of statistics."""
_METHOD = "stratified bootstrap"

Statistic = Callable[[NDArray[np.float64]], NDArray[np.float64]]
"""From (..., runs) to (...), over the last axis."""


@dataclass(frozen=True, slots=True)
class Band:
    """Estimates along a curve with their confidence intervals, one by one: each of shape (points,)."""

    estimate: NDArray[np.float64]
    low: NDArray[np.float64]
    high: NDArray[np.float64]


def interquartile_mean(scores: ArrayLike) -> float:
    """Mean of the middle half of all scores, of any shape: a quarter is trimmed at each end, rounded down
    (Agarwal et al. 2021; `scipy.stats.trim_mean` with 0.25). Raises ValueError if there is none."""
    return float(_trimmed(sample_of(np.ravel(scores), "scores")))


def stratified_bootstrap_interval(
    scores: Sequence[ArrayLike],
    statistic: Statistic | None = None,
    confidence: float = CONFIDENCE,
    resamples: int = RESAMPLES,
    seed: int = 0,
) -> Interval:
    """A statistic over all scores (default: the interquartile mean) with its percentile interval by the
    stratified bootstrap: runs are drawn with replacement within each task (Agarwal et al. 2021).

    `statistic` maps (..., scores) to (...). Raises ValueError if a task has no scores or `confidence` is not
    within 0 and 1.
    """
    check_confidence(confidence)
    tasks = _tasks(scores, "scores")
    evaluate = statistic or _trimmed
    generator = np.random.default_rng(seed)
    drawn = [task[_draw(generator, len(task), resamples)] for task in tasks]
    estimate = float(evaluate(np.concatenate(tasks)))
    low, high = _percentiles(evaluate(np.concatenate(drawn, axis=-1)), confidence)
    return Interval(estimate, float(low), float(high), confidence, _METHOD)


def probability_of_improvement(
    a: Sequence[ArrayLike],
    b: Sequence[ArrayLike],
    confidence: float = CONFIDENCE,
    resamples: int = BAND_RESAMPLES,
    seed: int = 0,
) -> Interval:
    """How probably a run of `a` scores above a run of `b` on the same task, ties counting half, averaged over
    the tasks (the Mann-Whitney statistic; Agarwal et al. 2021), with its percentile interval: the runs of
    both are drawn with replacement within each task.

    Raises ValueError as `stratified_bootstrap_interval`, and where the numbers of tasks differ.
    """
    check_confidence(confidence)
    left, right = _tasks(a, "a"), _tasks(b, "b")
    if len(left) != len(right):
        raise ValueError(f"a has {len(left)} tasks and b has {len(right)}: give as many")
    generator = np.random.default_rng(seed)
    estimates, drawn = [], []
    for ours, theirs in zip(left, right, strict=True):
        wins = (np.sign(ours[:, None] - theirs) + 1) / 2
        rows = _draw(generator, len(ours), resamples)
        columns = _draw(generator, len(theirs), resamples)
        estimates.append(wins.mean())
        drawn.append(wins[rows[:, :, None], columns[:, None, :]].mean(axis=(1, 2)))
    low, high = _percentiles(np.mean(drawn, axis=0), confidence)
    return Interval(float(np.mean(estimates)), float(low), float(high), confidence, _METHOD)


def performance_profile(
    scores: Sequence[ArrayLike],
    thresholds: ArrayLike,
    confidence: float = CONFIDENCE,
    resamples: int = BAND_RESAMPLES,
    seed: int = 0,
) -> Band:
    """The share of runs that score above each of `thresholds`, shape (points,), with the percentile interval
    of each (run-score distributions; Agarwal et al. 2021). Raises as `stratified_bootstrap_interval`."""
    check_confidence(confidence)
    tasks, points = _tasks(scores, "scores"), sample_of(thresholds, "thresholds")
    generator = np.random.default_rng(seed)
    drawn = [task[_draw(generator, len(task), resamples)] for task in tasks]
    everything, resampled = np.concatenate(tasks), np.concatenate(drawn, axis=-1)
    shares = np.stack([(resampled > point).mean(axis=-1) for point in points], axis=-1)
    low, high = _percentiles(shares, confidence)
    return Band((everything[:, None] > points).mean(axis=0), low, high)


def sample_efficiency(
    curves: Sequence[ArrayLike],
    confidence: float = CONFIDENCE,
    resamples: int = BAND_RESAMPLES,
    seed: int = 0,
) -> Band:
    """The interquartile mean at each point of the curves, with its percentile interval: whole runs are drawn
    with replacement within each task (Agarwal et al. 2021).

    `curves` holds one array of shape (runs, points) a task. Raises as `stratified_bootstrap_interval`, and
    where the numbers of points differ.
    """
    check_confidence(confidence)
    tasks = [sample_of(task, f"curves[{index}]", axes=2) for index, task in enumerate(curves)]
    if len({task.shape[1] for task in tasks}) != 1:
        raise ValueError("curves must hold at least one task, and all tasks as many points")
    generator = np.random.default_rng(seed)
    drawn = [_draw(generator, len(task), resamples) for task in tasks]
    everything = np.concatenate(tasks)
    resampled = np.stack(
        [
            _trimmed(
                np.concatenate([task[rows, point] for task, rows in zip(tasks, drawn, strict=True)], axis=-1)
            )
            for point in range(everything.shape[1])
        ],
        axis=-1,
    )
    low, high = _percentiles(resampled, confidence)
    return Band(_trimmed(everything.T), low, high)


def normalised(score: ArrayLike, random: float, best: float) -> NDArray[np.float64]:
    """Scores on the scale on which random play is 0 and the best rule 1, so that environments may be put
    together. Raises ValueError where the best rule does not score above random play."""
    if not random < best:
        raise ValueError(f"the best rule ({best:g}) must score above random play ({random:g})")
    return (np.asarray(score, np.float64) - random) / (best - random)


def _trimmed(scores: NDArray[np.float64]) -> NDArray[np.float64]:
    count = scores.shape[-1]
    cut = count // 4
    middle: NDArray[np.float64] = np.sort(scores, axis=-1)[..., cut : count - cut].mean(axis=-1)
    return middle


def _tasks(scores: Sequence[ArrayLike], name: str) -> list[NDArray[np.float64]]:
    if not len(scores):
        raise ValueError(f"{name} must hold at least one task")
    return [sample_of(task, f"{name}[{index}]") for index, task in enumerate(scores)]


def _draw(generator: np.random.Generator, runs: int, resamples: int) -> NDArray[np.int64]:
    return generator.integers(0, runs, (resamples, runs))


def _percentiles(
    resampled: NDArray[np.float64], confidence: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    low, high = np.quantile(resampled, [(1 - confidence) / 2, (1 + confidence) / 2], axis=0)
    return low, high
