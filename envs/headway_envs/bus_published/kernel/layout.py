"""Records and arrays of the kernel.

Axes: C copies, N buses, R routes, S stops. Times are
in seconds; those of clocks are after midnight.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Record = Any
"""One element of an array of SETTINGS, BUS, STOP or DAY. Compiled code reads fields as attributes."""

WAIT, MOVE, SERVICE_CENTER = 0, 1, 2
"""Actions."""
ACTIONS = 3

WAIT_S = 60.0
"""Duration of WAIT, s."""
WAIT_REWARD = -0.1
"""Reward of WAIT."""
SERVICE_REWARD_S = 600.0
"""Unit of the detour in the reward of service, -(1 + detour / this), s."""
REFUSED_REWARD = -20.0
"""Reward of SERVICE_CENTER if the fuel does not last for the way to the centre."""
DETOUR_SHARE = 0.3
"""Duration of the way to the centre as a share of the shortest path's time. The way back takes no time."""
FUEL_CAPACITY = 100.0
"""Capacity of the tank, fuel units."""
FUEL_UNIT_S = 300.0
"""Time per fuel unit, s, also at stops. A bus with an empty tank can still drive, but not to the centre."""
UPTIME_S = 12.0 * 3600.0
"""Time over which the uptime falls from 1 to 0, s."""
LONGEST_LINK_S = 3250.0
"""Unit of link times in observations, s."""
CAPACITY = 80.0
"""Number of passengers at occupancy 1."""
DAY_S = 86400.0


class Network(NamedTuple):
    """Part of the simulation that all copies share."""

    route_first: NDArray[np.int64]
    """(R + 1,) position of each route's first stop in `route_stop`"""
    route_stop: NDArray[np.int64]
    """stops of route 0 in order, then of route 1, ..."""
    route_share: NDArray[np.float64]
    """(R,) share of the day's trips on this route and those before it: cumulative, the last is 1"""
    expected_s: NDArray[np.float64]
    """(R,) duration of one trip to the end of the route, s"""
    travel_s: NDArray[np.float64]
    """(S, S) time of the link from a stop to another, s; the mean over all links where there is no link"""
    detour_s: NDArray[np.float64]
    """(S, S) shortest-path time from a stop to another, s; infinite where there is no path"""
    occupancy: NDArray[np.float64]
    """(S,) mean load of departing buses over CAPACITY; NaN at stops without buses"""
    demand: NDArray[np.float64]
    """(S,) boardings per day"""
    centres: NDArray[np.int64]
    """stops from which the service centre is drawn"""


SETTINGS = np.dtype(
    [
        (name, np.float64)
        for name in (
            "start_s",
            "end_s",
            "weight_occupancy",
            "weight_uptime",
            "weight_regularity",
            "weight_efficiency",
            "low_occupancy",
            "high_occupancy",
            "target_headway_s",
            "demand_unit",
            "stop_unit",
        )
    ]
    + [(name, np.int64) for name in ("shared", "max_steps")],
    align=True,
)
"""Numbers of the configuration that the kernel reads. `demand_unit` and `stop_unit` divide demand and stop
numbers in observations."""

BUS = np.dtype(
    [
        ("clock", np.float64),  # time of the bus, s after midnight
        ("driven", np.float64),  # driving time so far, including that to the centre, s
        ("occupancy", np.float64),
        ("uptime", np.float64),
        ("fuel", np.float64),
        ("route", np.int64),
        ("place", np.int64),  # position on its route
        ("stop", np.int64),  # observed stop: that of `place`, or the centre after service
        ("backward", np.int64),  # 1 on the way back
    ],
    align=True,
)
"""State of a bus."""

STOP = np.dtype(
    [
        ("arrivals", np.int64),  # number of arrivals
        ("intervals", np.int64),  # number of intervals above 0
        ("last", np.float64),  # time of the last arrival, s
        ("squares", np.float64),  # sum of (interval - target)^2
    ],
    align=True,
)
"""Arrivals at one stop, in the order in which they were simulated. Clocks of buses differ, so an arrival may
lie before an earlier one in time."""

DAY = np.dtype(
    [("seed", np.uint64)]
    + [(name, np.int64) for name in ("number", "step", "centre", "moves", "waits", "services", "refused")]
    + [(name, np.float64) for name in ("reward", "uptime", "occupancy", "regularity", "efficiency")],
    align=True,
)
"""State and totals of the day of one copy. `uptime`, `occupancy`, `regularity` and `efficiency` are sums over
moves of the reward's u, o, h and t."""


class World(NamedTuple):
    """State of C copies. It is complete: copies of these arrays make up a snapshot."""

    days: NDArray[Any]
    """(C,) DAY records"""
    buses: NDArray[Any]
    """(C, N) BUS records"""
    stops: NDArray[Any]
    """(C, S) STOP records"""


class Outputs(NamedTuple):
    """Arrays that a step fills, in the shapes of `headway.contracts`."""

    observations: NDArray[np.float32]
    rewards: NDArray[np.float32]
    terminated: NDArray[np.bool_]
    truncated: NDArray[np.bool_]
    ended: NDArray[np.bool_]
    final_observations: NDArray[np.float32]
    metrics: NDArray[np.float64]


OBSERVATION_SIZE = 8
