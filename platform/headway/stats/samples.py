"""Records of statistics, and the checks of their samples."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

CONFIDENCE = 0.95
"""Confidence of every interval."""


@dataclass(frozen=True, slots=True)
class MeanStd:
    """Mean over `count` seeds with the sample standard deviation (ddof = 1; NaN for one seed)."""

    mean: float
    std: float
    count: int


@dataclass(frozen=True, slots=True)
class Interval:
    """An estimate with its interval, of 95% unless said otherwise."""

    estimate: float
    low: float
    high: float
    method: str
    """Method of the interval, and what it averages over: `t over episodes`."""

    @property
    def excludes_zero(self) -> bool:
        """Both ends are on the same side of 0."""
        return self.low > 0 or self.high < 0


def mean_std(values: ArrayLike) -> MeanStd:
    """Return mean and sample standard deviation (ddof = 1) of one value per seed, shape (seeds,).

    Raises ValueError if there are no values or one is not finite.
    """
    sample = as_sample(values, "values")
    std = float(sample.std(ddof=1)) if len(sample) > 1 else float("nan")
    return MeanStd(float(sample.mean()), std, len(sample))


def as_sample(values: ArrayLike, name: str, axes: int = 1) -> NDArray[np.float64]:
    """Return `values` as a float64 array with `axes` axes; `name` is used in messages.

    Raises ValueError if the array is empty, has another number of axes, or holds values that are not finite.
    """
    sample = np.asarray(values, np.float64)
    if sample.ndim != axes or not sample.size:
        kind = "a row of at least one number" if axes == 1 else f"numbers along {axes} axes"
        raise ValueError(f"{name} must be {kind}, not of shape {sample.shape}")
    if not np.isfinite(sample).all():
        raise ValueError(f"{name} must be finite")
    return sample
