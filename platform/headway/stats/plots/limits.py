"""Limits of axes: what may extend them, and outliers, which may not."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from numpy.typing import NDArray

OUTLIER_FACTOR = 5.0
"""Values farther from the others than this multiple of their range do not extend an axis; the legend states
them."""


def outliers(values: Mapping[str, "NDArray[np.floating[Any]]"], sign: int = 1) -> dict[str, float]:
    """Return the worst value of each controller that is far worse than most, such as one that diverged.

    "Most" are the more than half of the controllers whose ranges lie closest together; far is more than five
    times their range, or five times the median range of all controllers if that is wider. Higher is better if
    `sign` is 1, lower if -1; far better is never an outlier. With fewer than three controllers there are
    none.
    """
    known = {name: of_name[np.isfinite(of_name)] for name, of_name in values.items()}
    known = {name: of_name for name, of_name in known.items() if len(of_name)}
    if len(known) < 3:
        return {}
    ranges = sorted((float(of_name.min()), float(of_name.max())) for of_name in known.values())
    most = len(ranges) // 2 + 1
    together = [ranges[first : first + most] for first in range(len(ranges) - most + 1)]
    low, high = min(
        ((near[0][0], max(end for _, end in near)) for near in together), key=lambda ends: ends[1] - ends[0]
    )
    # Points of few seeds may agree by chance: without a usual range there are no outliers.
    usual = float(np.diff(np.median(ranges, axis=0))[0])
    excluded = {}
    for name, of_name in known.items():
        distances = np.maximum(low - of_name if sign > 0 else of_name - high, 0.0)
        if usual > 0 and distances.max() > OUTLIER_FACTOR * max(high - low, usual):
            excluded[name] = float(of_name[distances.argmax()])
    return excluded


def extend_axis(axes: "Axes", values: Sequence[float]) -> None:
    """Extend the vertical axis to `values`, with a margin beyond them."""
    if not values:
        return
    low, high = axes.get_ylim()
    edge = 0.05 * (max(high, *values) - min(low, *values))
    axes.set_ylim(min(low, min(values) - edge), max(high, max(values) + edge))


def bound_bands(axes: "Axes", middles: "NDArray[np.floating[Any]]") -> None:
    """Let bands extend the vertical axis to twice the range of the curves at most.

    The intervals of two seeds can be a hundred times as wide as that range and would flatten all curves.
    """
    low, high = float(np.nanmin(middles)), float(np.nanmax(middles))
    if low < high:
        beyond, (bottom, top) = 0.5 * (high - low), axes.get_ylim()
        axes.set_ylim(max(bottom, low - beyond), min(top, high + beyond))


def note_cut_bands(axes: "Axes", low: float, high: float) -> None:
    """Note above a panel that its axis does not show all of the bands, which extend from `low` to `high`."""
    bottom, top = axes.get_ylim()
    if low < bottom or high > top:
        axes.set_title("some intervals continue beyond the axis", loc="right", fontsize="small", color="0.35")
