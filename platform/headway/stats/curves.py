"""Figures of one run's curve: its final reward and its area."""

from collections.abc import Iterable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from headway.stats.samples import sample_of

FINAL_SHARE = 0.2
"""Share of the curve's steps over which the final reward is taken."""
FEWEST_POINTS = 3
"""Of a curve of fewer the area normalised by its own range is 0.5, whatever was learnt."""


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
    early a run learns, not how well; NaN for fewer than `FEWEST_POINTS`). With study-wide bounds `low` and
    `high` (`value_range`), runs may be ranked, values outside count as they are, and a curve of one point has
    the area of its normalised value. A flat curve has no shape: with its own extremes its area is 0.5 by
    definition.

    Raises ValueError for a curve that is empty or unordered, one bound alone, or `low` not below `high`.
    """
    steps, curve = _curve(env_steps, values)
    if (low is None) != (high is None):
        raise ValueError("give both low and high, or neither")
    if low is None or high is None:
        if len(curve) < FEWEST_POINTS:
            return float("nan")
        low, high = float(curve.min()), float(curve.max())
        if low == high:
            return 0.5
    elif not low < high:
        raise ValueError(f"low {low} must be below high {high}")
    scaled = (curve - low) / (high - low)
    if len(steps) == 1:
        return float(scaled[0])
    return float(np.trapezoid(scaled, steps) / (steps[-1] - steps[0]))


def value_range(curves: Iterable[ArrayLike]) -> tuple[float, float]:
    """The lowest and the highest value of all curves of a study on one environment: the bounds of `auc`'s
    study-wide normalisation. Raises ValueError if there are none."""
    samples = [sample_of(curve, "curve") for curve in curves]
    if not samples:
        raise ValueError("curves must hold at least one")
    return min(float(curve.min()) for curve in samples), max(float(curve.max()) for curve in samples)


def _curve(env_steps: ArrayLike, values: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    steps, curve = sample_of(env_steps, "env_steps"), sample_of(values, "values")
    if steps.shape != curve.shape:
        raise ValueError(f"env_steps has {len(steps)} points and values has {len(curve)}: give as many")
    if np.any(np.diff(steps) <= 0):
        raise ValueError("env_steps must increase from point to point")
    return steps, curve
