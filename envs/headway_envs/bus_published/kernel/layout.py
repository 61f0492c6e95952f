"""The records that the kernel works on.

Axes: C copies, N buses, R routes, K calls (the different stops on routes), S stops of the scenario. Times are
seconds, clocks after midnight.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Record = Any
"""One element of an array of SETTINGS, BUS, CALL or DAY; fields are attributes in compiled code."""

WAIT, MOVE, SERVICE_CENTER = 0, 1, 2
"""Actions."""
ACTIONS = 3

WAIT_S = 60.0
"""WAIT lasts."""
WAIT_REWARD = -0.1
SERVICE_REWARD_S = 600.0
"""Service is paid -(1 + detour / this)."""
REFUSED_REWARD = -20.0
"""Service without fuel for the way."""
DETOUR_SHARE = 0.3
"""Of the shortest path's time that the way to the centre takes; the way back takes none."""
FUEL_CAPACITY = 100.0
FUEL_UNIT_S = 300.0
"""One unit of fuel lasts, at a stop too. An empty tank hinders nothing but the way to the centre."""
UPTIME_S = 12.0 * 3600.0
"""The uptime falls from 1 to 0 in."""
LONGEST_LINK_S = 3250.0
"""Link times are observed in units of."""
CAPACITY = 80.0
"""Passengers that an occupancy of 1 stands for."""
DAY_S = 86400.0


class Network(NamedTuple):
    """What all copies share."""

    route_first: NDArray[np.int64]
    """(R + 1,) where each route begins in `route_call`"""
    route_call: NDArray[np.int64]
    """calls of route 0 in order, of route 1, ..."""
    expected_s: NDArray[np.float64]
    """(R,) time of one trip out"""
    call_stop: NDArray[np.int64]
    """(K,) the stop of each call"""
    travel_s: NDArray[np.float64]
    """(S, K) mean time of the link from a stop to a call; where there is none, the mean of all links"""
    detour_s: NDArray[np.float64]
    """(K, S) shortest-path time from a call to a stop; infinite where none leads there"""
    occupancy: NDArray[np.float64]
    """(K,) mean load over `CAPACITY`"""
    demand: NDArray[np.float64]
    """(S,) boardings a day"""
    centres: NDArray[np.int64]
    """stops of which one is drawn as the service centre"""


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
    + [(name, np.int64) for name in ("shared", "max_steps", "agents_per_route")],
    align=True,
)
"""The configuration's numbers as the kernel reads them; `demand_unit` and `stop_unit`: what demand and the
numbers of stops are divided by when observed."""

BUS = np.dtype(
    [
        (name, np.float64)
        for name in (
            "clock",
            "driven",
            "occupancy",
            "uptime",
            "fuel",
        )  # driven: s, on the way to a centre too
    ]
    + [
        ("place", np.int64),  # on its route
        ("stop", np.int64),  # where it is seen: there, or at the centre after service
        ("backward", np.int64),
    ],
    align=True,
)
"""State of a bus."""

CALL = np.dtype(
    [
        ("arrivals", np.int64),
        ("intervals", np.int64),  # of them those above 0
        ("last", np.float64),
        ("squares", np.float64),  # sum of (interval - target)^2
    ],
    align=True,
)
"""Arrivals at a call, in the order in which they were made; clocks differ, so that some lie back in time."""

DAY = np.dtype(
    [("seed", np.uint64)]
    + [(name, np.int64) for name in ("number", "step", "centre", "moves", "waits", "services", "refused")]
    + [(name, np.float64) for name in ("reward", "uptime", "occupancy", "regularity", "efficiency")],
    align=True,
)
"""State and accounts of a copy's day. The last four are sums over moves: of o, u, h and t."""


class World(NamedTuple):
    """The state of C copies: all of it, so that a copy of these arrays is a snapshot."""

    days: NDArray[Any]
    """(C,) DAY"""
    buses: NDArray[Any]
    """(C, N) BUS"""
    calls: NDArray[Any]
    """(C, K) CALL"""


class Outputs(NamedTuple):
    """What a step fills, in the shapes of `headway.contracts`."""

    observations: NDArray[np.float32]
    rewards: NDArray[np.float32]
    terminated: NDArray[np.bool_]
    truncated: NDArray[np.bool_]
    ended: NDArray[np.bool_]
    final_observations: NDArray[np.float32]
    metrics: NDArray[np.float64]


OBSERVATION_SIZE = 8

METRICS = [
    "team_reward",
    "steps",
    "moves",
    "waits",
    "service_visits",
    "services_refused",
    "occupancy_cost",
    "uptime",
    "regularity",
    "efficiency",
]
"""Names of the episode metrics; `meanings` says what they are."""
