"""Metrics of one run's learning curve: final reward and area under the curve (AUC)."""

from collections.abc import Iterable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from headway.stats.samples import as_sample

FINAL_SHARE = 0.2
"""Last share of the curve's steps, over which the final reward is averaged."""
FEWEST_POINTS = 3
"""Minimum number of points for an area normalised by the curve's own range: with two it is always 0.5."""


def final_reward(env_steps: ArrayLike, values: ArrayLike) -> float:
    """Return the mean of the values over the last 20% of the curve's steps; the last value always counts.

    `env_steps` and `values` have shape (points,). Raises ValueError for an empty curve and for steps that do
    not increase.
    """
    steps, curve = _curve(env_steps, values)
    start = steps[-1] - FINAL_SHARE * (steps[-1] - steps[0])
    return float(curve[steps >= start].mean())


def auc(
    env_steps: ArrayLike, values: ArrayLike, low: float | None = None, high: float | None = None
) -> float:
    """Return the area under the min-max-normalised curve over its span of steps, by the trapezoid rule.

    Without bounds, the curve's own minimum and maximum become 0 and 1: per-run normalisation, as published.
    This area, in [0, 1], measures how early a run learns, not how well. It is 0.5, by definition, for a flat
    curve.

    With study-wide bounds `low` and `high` (see `value_range`) runs can be ranked. Values outside the bounds
    are not clipped. Either area is NaN for fewer than `FEWEST_POINTS` points.

    Raises ValueError for an empty curve, steps that do not increase, a single bound, and `low` not below
    `high`.
    """
    steps, curve = _curve(env_steps, values)
    if (low is None) != (high is None):
        raise ValueError("give both low and high, or neither")
    if len(curve) < FEWEST_POINTS:
        return float("nan")
    if low is None or high is None:
        low, high = float(curve.min()), float(curve.max())
        if low == high:
            return 0.5
    elif not low < high:
        raise ValueError(f"low {low} must be below high {high}")
    scaled = (curve - low) / (high - low)
    return float(np.trapezoid(scaled, steps) / (steps[-1] - steps[0]))


def value_range(curves: Iterable[ArrayLike]) -> tuple[float, float]:
    """Return the lowest and highest value of several curves: the bounds of a study-wide `auc`.

    Raises ValueError if there are no curves.
    """
    samples = [as_sample(curve, "curve") for curve in curves]
    if not samples:
        raise ValueError("curves must hold at least one curve")
    return min(float(curve.min()) for curve in samples), max(float(curve.max()) for curve in samples)


def _curve(env_steps: ArrayLike, values: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return steps and values, checked, shape (points,) each."""
    steps, curve = as_sample(env_steps, "env_steps"), as_sample(values, "values")
    if steps.shape != curve.shape:
        raise ValueError(
            f"env_steps has {len(steps)} points and values has {len(curve)}: both need the same number"
        )
    if np.any(np.diff(steps) <= 0):
        raise ValueError("env_steps must increase from point to point")
    return steps, curve
