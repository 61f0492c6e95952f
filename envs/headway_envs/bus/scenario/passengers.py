"""Synthetic passengers for scenarios without passenger data, from their trips and fitted parameters."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from headway.contracts import generator
from headway_envs.bus.kernel.layout import KNOT_S
from headway_envs.bus.scenario.fitted import (
    ALIGHTING_TENTHS,
    ATTRACTIVENESS_SD,
    BOARDING_TENTHS,
    HOUR_SHARES,
)
from headway_envs.bus.scenario.tables import Columns, stack
from headway_envs.bus.scenario.timetable import smooth_departures

if TYPE_CHECKING:
    import pandas as pd

Floats = NDArray[np.float64]

FIRST_SHARE_HOUR = 5
"""Hour of the first of HOUR_SHARES. Earlier hours take the first share, later ones the last."""
_LAST_HOUR = 29
"""Last hour of demand; passengers of later hours are added to it."""
ALIGHTING_SD = 1.0
"""Assumption: sd of the log of the alightings at a stop within its tenth of the pattern."""


def spread_by_tenth(tenths: Sequence[float], weight: Floats) -> Floats:
    """Return the shares (n,), sum 1, of the n stops of a pattern.

    The share of each tenth of the pattern is divided among its stops by `weight` (n,).
    """
    tenth = np.minimum(np.arange(len(weight)) * 10 // len(weight), 9)
    total = np.bincount(tenth, weight, minlength=10)[tenth]
    share = np.array(tenths)[tenth] * weight / np.maximum(total, 1e-12)
    return np.asarray(share / share.sum(), np.float64)


def alighting_shares(boarding: Floats, alighting: Floats) -> Floats:
    """Return the share of the load on arrival that alights at each stop (n,); 1 at the last stop."""
    alight, load = np.zeros(len(boarding)), 0.0
    for stop in range(len(boarding)):
        leaving = min(alighting[stop], 0.95 * load)
        alight[stop] = leaving / load if load > 0 else 0.0
        load += boarding[stop] - leaving
    alight[-1] = 1.0
    return alight


def synthetic_passengers(
    calls: "pd.DataFrame", trips: "pd.DataFrame", per_trip: Mapping[str, Mapping[int, float]], seed: int
) -> tuple["pd.DataFrame", "pd.DataFrame"]:
    """Return the tables demand and alighting for the given rows of pattern_stops and trips.

    Each stop has one random weight for boardings and one for alightings, the same on all patterns that call
    there, within the tenth of each pattern. `per_trip`: mean boardings per trip, by day type and pattern. At
    each stop they are divided among the hours in which buses serve it, by the fitted shares.
    """
    import pandas as pd

    places, which = np.unique(calls["stop"].to_numpy(), return_inverse=True)
    draws = generator(seed, "bus stops", 0)
    boarding_weights = draws.lognormal(0.0, ATTRACTIVENESS_SD, len(places))[which]
    alighting_weights = draws.lognormal(0.0, ALIGHTING_SD, len(places))[which]
    numbers, first = np.unique(calls["pattern"].to_numpy(), return_index=True)
    ends = np.append(first[1:], len(calls))
    trips_by_pattern = dict(list(trips.groupby(["daytype", "pattern"])))
    demand: list[Columns] = []
    alighting: list[Columns] = []
    days: list[str] = []
    for pattern, begin, end in zip(numbers.tolist(), first, ends, strict=True):
        weight, alighting_weight = boarding_weights[begin:end].copy(), alighting_weights[begin:end].copy()
        weight[-1] = alighting_weight[0] = 0.0
        boarding = spread_by_tenth(BOARDING_TENTHS, weight)
        alight = alighting_shares(boarding, spread_by_tenth(ALIGHTING_TENTHS, alighting_weight))
        alighting.append(_by_period(pattern, alight))
        for day, means in per_trip.items():
            if (day, pattern) in trips_by_pattern:
                rows = _boardings(pattern, day, boarding, trips_by_pattern[day, pattern], means[pattern])
                demand.append(rows)
                days += [day] * len(rows["board"])
    return pd.DataFrame(stack(demand)).assign(daytype=days), pd.DataFrame(stack(alighting))


def _by_period(pattern: int, alight: Floats) -> Columns:
    """Return the rows of the table alighting of one pattern; all periods have the same shares."""
    count = len(alight)
    return {
        "pattern": np.full(4 * count, pattern, np.int32),
        "seq0": np.repeat(np.arange(count, dtype=np.int16), 4),
        "period": np.tile(np.arange(4, dtype=np.int8), count),
        "p_alight": np.repeat(alight, 4),
    }


def _boardings(pattern: int, day: str, boarding: Floats, trips: "pd.DataFrame", mean: float) -> Columns:
    """Return the rows of the table demand of one pattern and day type."""
    departures = trips["dep_s"].to_numpy(np.float64)
    hours, served = service_by_hour(len(boarding), trips)
    shares = np.interp(hours, FIRST_SHARE_HOUR + np.arange(len(HOUR_SHARES[day])), HOUR_SHARES[day])
    weights = served * shares
    weights /= weights.sum(axis=1, keepdims=True)
    leaving = np.bincount((departures // 3600).astype(np.int64), minlength=51)[hours]
    count = len(boarding)
    return {
        "pattern": np.full(count * len(hours), pattern, np.int32),
        "seq0": np.repeat(np.arange(count, dtype=np.int16), len(hours)),
        "hour": np.tile(hours.astype(np.int8), count),
        "calls": np.tile(leaving.astype(np.int32), count),
        "board": (mean * len(departures) * boarding[:, None] * weights).ravel(),
    }


def service_by_hour(count: int, trips: "pd.DataFrame") -> tuple[NDArray[np.int64], Floats]:
    """Return hours (H,) and, per stop and hour, the share (count, H) of the passengers for whom a bus comes.

    Passengers arrive from one headway before the first bus to the last bus, as in `network.build`. Those of
    an hour arrive from the middle of the previous hour to the middle of the next one, most of them within the
    hour. Stops are assumed to be reached at even intervals. Hours with less than half the share of the best
    hour get 0.
    """
    departures = np.sort(trips["dep_s"].to_numpy(np.float64))
    headway = np.interp(departures[0], KNOT_S, smooth_departures(departures, KNOT_S).headway)
    lasting = float((trips["arr_s"].to_numpy(np.float64) - trips["dep_s"].to_numpy(np.float64)).mean())
    reached = np.linspace(0.0, lasting, count)
    opens, closes = departures[0] - headway + reached, departures[-1] + reached
    # A service day may begin in the hour of the first bus; passengers of earlier hours would be missing.
    earliest = max(min(departures[0] // 3600.0, FIRST_SHARE_HOUR), opens[0] // 3600.0, 0.0)
    hours = np.arange(int(min(earliest, _LAST_HOUR)), min(int(closes[-1] // 3600.0), _LAST_HOUR) + 1)
    served = _arrived_share(closes[:, None], hours) - _arrived_share(opens[:, None], hours)
    # Stops that are reached only after the last hour: all their passengers belong to it.
    served[served.max(axis=1) <= 0.0, -1] = 1.0
    best = served.max(axis=1, keepdims=True)
    return hours, np.where(served >= 0.5 * best, served, 0.0)


def _arrived_share(time: Floats, hours: NDArray[np.int64]) -> Floats:
    """Return the share of each hour's passengers who have arrived by a time, s."""
    since = np.clip(time / 3600.0 - hours - 0.5, -1.0, 1.0)
    return np.asarray(0.5 + since - 0.5 * since * np.abs(since), np.float64)
