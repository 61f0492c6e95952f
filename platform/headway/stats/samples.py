"""What a statistic may be taken of, and the records that statistics are."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

CONFIDENCE = 0.95


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


def mean_std(values: ArrayLike) -> MeanStd:
    """Mean and sample standard deviation (ddof = 1) of one figure a seed, shape (seeds,).

    Raises ValueError if there is none.
    """
    sample = sample_of(values, "values")
    std = float(sample.std(ddof=1)) if len(sample) > 1 else float("nan")
    return MeanStd(float(sample.mean()), std, len(sample))


def sample_of(values: ArrayLike, name: str, axes: int = 1) -> NDArray[np.float64]:
    """`values` as floats; `name` is what messages call them.

    Raises ValueError if they are none, not finite, or have another number of axes.
    """
    sample = np.asarray(values, np.float64)
    if sample.ndim != axes or not sample.size:
        kind = "a row of at least one number" if axes == 1 else f"numbers along {axes} axes"
        raise ValueError(f"{name} must be {kind}, not of shape {sample.shape}")
    if not np.isfinite(sample).all():
        raise ValueError(f"{name} must be finite")
    return sample


def check_confidence(confidence: float) -> None:
    """Raise ValueError for a confidence not within 0 and 1."""
    if not 0 < confidence < 1:
        raise ValueError(f"confidence {confidence} must be between 0 and 1")
