"""Curves over the day, given at hour knots or in quarter-hour bins."""

import numpy as np
from numpy.typing import NDArray

from headway_envs.bus.kernel.compiled import compiled
from headway_envs.bus.kernel.layout import BIN_S, FIRST_KNOT_HOUR, KNOTS, PERIOD_ENDS_S

_FIRST_KNOT_S = FIRST_KNOT_HOUR * 3600.0 + 1800.0


@compiled
def interpolate(curves: NDArray[np.float64], row: int, time: float) -> float:
    """Return row `row` of (rows, K) knot values at `time`: linear between knots, constant outside."""
    place = (time - _FIRST_KNOT_S) / 3600.0
    if place <= 0.0:
        return float(curves[row, 0])
    if place >= KNOTS - 1:
        return float(curves[row, KNOTS - 1])
    knot = int(place)
    weight = place - knot
    return float((1.0 - weight) * curves[row, knot] + weight * curves[row, knot + 1])


@compiled
def bin_of(time: float, start: float, bins: int) -> int:
    """Return the quarter-hour bin of the service day that contains `time`; times outside take the nearest
    bin."""
    return min(max(int((time - start) / BIN_S), 0), bins - 1)


@compiled
def period_of(time: float) -> int:
    """Return the period of `Network.alighting` (0 to 3) that contains `time`."""
    if time < PERIOD_ENDS_S[0]:
        return 0
    if time < PERIOD_ENDS_S[1]:
        return 1
    return 2 if time < PERIOD_ENDS_S[2] else 3
