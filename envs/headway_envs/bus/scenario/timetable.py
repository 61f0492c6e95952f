"""Timetable: departures, evenly spread or as observed, chained into the blocks of the slots."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from headway_envs.bus.config import BusConfig

MIN_HEADWAY_S, MAX_HEADWAY_S = 150.0, 5400.0
"""Limits of the target headway, s."""


@dataclass(frozen=True)
class Departures:
    """Departures of one pattern on one day."""

    times: NDArray[np.float64]
    """(J,) departure times, s, in order"""
    knots: NDArray[np.float64]
    """(K,) times of the knots, s"""
    headway: NDArray[np.float64]
    """(K,) target headway at the knots, s"""


def smooth_departures(observed: NDArray[Any], knots: NDArray[np.float64]) -> Departures:
    """Spread a pattern's observed departures (s, any order) evenly.

    The departures per hour, smoothed over three hours with weights 1/4, 1/2, 1/4 and interpolated, give a
    rate. Departures lie where its integral, scaled to their number, is an integer.
    """
    observed = np.sort(observed)
    first, last, count = observed[0], observed[-1], len(observed)
    if count == 1:
        return Departures(observed, knots, np.full(len(knots), MAX_HEADWAY_S))
    begin = knots - 1800.0
    hourly = np.array([np.sum((observed >= b) & (observed < b + 3600.0)) for b in begin], np.float64)
    # The hours of the first and the last departure are only partly in service.
    share = np.clip((np.minimum(begin + 3600.0, last) - np.maximum(begin, first)) / 3600.0, 0.0, 1.0)
    rate = np.where(share > 0.25, hourly / np.maximum(share, 0.25), np.nan)
    if np.isnan(rate).all():
        rate = np.full(len(knots), (count - 1) / max(last - first, 60.0) * 3600.0)
    inside = np.flatnonzero(~np.isnan(rate))
    rate = np.interp(np.arange(len(rate)), inside, rate[inside])
    padded = np.concatenate((rate[:1], rate, rate[-1:]))
    rate = 0.25 * padded[:-2] + 0.5 * padded[1:-1] + 0.25 * padded[2:]
    rate = np.maximum(rate, 3600.0 / MAX_HEADWAY_S)
    grid = np.linspace(first, last, max(int((last - first) // 60.0), 1) + 1)
    flow = np.interp(grid, knots, rate)
    total = np.concatenate(([0.0], np.cumsum(0.5 * (flow[1:] + flow[:-1]) * np.diff(grid))))
    scale = total[-1] / (count - 1)
    times = np.interp(np.arange(count) * scale, total, grid)
    headway = np.clip(3600.0 / rate * scale / 3600.0, MIN_HEADWAY_S, MAX_HEADWAY_S)
    return Departures(times, knots, headway)


def observed_departures(observed: NDArray[Any], knots: NDArray[np.float64]) -> Departures:
    """Return a pattern's departures (s, any order) unchanged.

    The target headway is that of `smooth_departures`.
    """
    return replace(smooth_departures(observed, knots), times=np.sort(observed))


@dataclass(frozen=True)
class Trip:
    """Trip in the timetable."""

    pattern: int
    """Index of the pattern."""
    departure: float
    """Planned departure, s."""
    arrival: float
    """Planned arrival, s."""


def chain_trips(
    trips: list[Trip], deadhead: NDArray[np.float64], first_pattern: int, recovery_share: float
) -> list[list[int]]:
    """Return the trips (indices, ordered by departure) of each slot of one line, for few buses.

    In order of departure, each trip goes to the bus that became ready last, so that other buses rest; a new
    bus is used only if none is ready. A bus is ready at its planned arrival, plus the recovery time (a share
    of the trip's duration, at least five minutes), plus the deadhead between the patterns' ends (s).
    """
    order = sorted(range(len(trips)), key=lambda i: (trips[i].departure, trips[i].pattern))
    slots: list[list[int]] = []
    for i in order:
        trip = trips[i]
        chosen, latest = -1, -np.inf
        for n, driven in enumerate(slots):
            last = trips[driven[-1]]
            recovery = max(300.0, recovery_share * (last.arrival - last.departure))
            way = float(deadhead[last.pattern - first_pattern, trip.pattern - first_pattern])
            ready = last.arrival + recovery + way
            if latest < ready <= trip.departure:
                chosen, latest = n, ready
        if chosen < 0:
            slots.append([i])
        else:
            slots[chosen].append(i)
    return slots


def work_until_depot(block: list[Trip], config: BusConfig) -> NDArray[np.float64]:
    """Return, per trip of a slot's block, the planned driving time until the next gap at the depot, s.

    The driving time of the trip itself is included.
    """
    left = np.zeros(len(block))
    for i in range(len(block) - 1, -1, -1):
        left[i] = block[i].arrival - block[i].departure
        if i + 1 < len(block):
            gap = block[i + 1].departure - config.dispatch_window_s - block[i].arrival
            left[i] += left[i + 1] if gap <= config.upkeep.depot_gap_s else 0.0
    return left
