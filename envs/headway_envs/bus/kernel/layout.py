"""The records that the kernel works on.

Axes: L lines, P patterns, N slots, J trips, C copies; Q calls (pattern x position, pattern after pattern),
K hour knots (values at half past each hour from FIRST_KNOT_HOUR on), B quarter hours of the service day.
Times are seconds after midnight.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Record = Any
"""One element of an array of SETTINGS, SLOT, QUEUE, PATTERN, LINE or DAY; fields are attributes in compiled
code."""

FIRST_KNOT_HOUR = 3
KNOTS = 25
"""Knots stand at 03:30, 04:30, ... 27:30."""
BIN_S = 900.0
"""Width of a bin of arrival rates and congestion, s."""
WAIT_BINS = 10800
"""One-second bins of passenger waits; the last holds all longer ones."""

DEPOT, TERMINAL, DISPATCHED, DRIVING, STANDING, AWAY, BROKEN = 0, 1, 2, 3, 4, 5, 6
"""Phases of a slot. TERMINAL: before a trip, decides; DISPATCHED: leaves when the dispatch delay is over;
STANDING: at a stop, boards, then decides; AWAY: at the service centre; BROKEN: waits to be towed."""

WAIT, MOVE, SERVICE_CENTER = 0, 1, 2
"""Actions."""

PAY_TEAM, PAY_LINE, PAY_OWN = 0, 1, 2
"""Whose reward a bus is paid."""


class Network(NamedTuple):
    """What all copies share: geometry, timetable, mean travel times and demand."""

    line_slots: NDArray[np.int64]
    """(L + 1,) first slot of each line"""
    line_patterns: NDArray[np.int64]
    """(L + 1,) first pattern of each line"""
    pattern_calls: NDArray[np.int64]
    """(P + 1,) first call of each pattern"""
    pattern_trips: NDArray[np.int64]
    """(P + 1,) first trip of each pattern; trips lie by pattern, then by departure"""
    trip_pattern: NDArray[np.int64]
    """(J,)"""
    trip_departure: NDArray[np.float64]
    """(J,) scheduled, s"""
    trip_deadhead: NDArray[np.float64]
    """(J,) s to drive from the end of the slot's trip before"""
    trip_work_left: NDArray[np.float64]
    """(J,) planned driving time of this trip and the slot's following ones, up to its next time at the depot,
    s"""
    slot_trips: NDArray[np.int64]
    """(J,) trips of slot 0 in order, of slot 1, ..."""
    slot_first: NDArray[np.int64]
    """(N + 1,) where each slot's trips begin in `slot_trips`"""
    slot_line: NDArray[np.int64]
    """(N,)"""
    running: NDArray[np.float64]
    """(Q, K) mean running time to the next call, dwell taken out, s"""
    nominal: NDArray[np.float64]
    """(Q, K) time from the first call of the pattern, mean dwell included, s"""
    noise_sd: NDArray[np.float64]
    """(Q,) sd of the log of the link term"""
    alighting: NDArray[np.float64]
    """(Q, 4) share of the load that alights: before 9 h, 9-15, 15-20, after"""
    arrival_rate: NDArray[np.float64]
    """(Q, B) passengers per s who come to wait, those who may leave by the competing service included"""
    boarding_rate: NDArray[np.float64]
    """(Q, B) passengers per s who board under a regular service"""
    regular_waiting: NDArray[np.float64]
    """(L, B) passengers that a regular service leaves waiting, on average"""
    target: NDArray[np.float64]
    """(P, K) target headway, s"""
    detour: NDArray[np.float64]
    """(Q,) one way to the nearest service centre, s"""
    queue_first: NDArray[np.int64]
    """(Q + 1,) where each call's queue begins in a copy's queue storage"""


SETTINGS = np.dtype(
    [
        (name, np.float64)
        for name in [
            "tick_s",
            "hold_s",
            "start_s",
            "end_s",
            "boarding_s",
            "alighting_s",
            "fixed_dwell_s",
            "captive_arrivals",
            "competing_share",
            "dispatch_window_s",
            "minimum_layover_s",
            "trip_sd",
            "day_sd",
            "evening_peak",
            "network_sd",
            "incident_probability",
            "incident_factor",
            "demand_day_sd",
            "demand_stop_hour_sd",
            "dispatch_s",
            "fuel_capacity",
            "fuel_per_s",
            "idle_share",
            "uptime_per_s",
            "warning",
            "hazard_per_s",
            "wear_growth",
            "broken_s",
            "service_s",
            "service_below",
            "depot_gap_s",
            "weight_service",
            "weight_efficiency",
            "weight_maintenance",
            "weight_regularity",
            "follower_share",
            "breakdown_cost",
            "low_occupancy",
        ]
    ]
    + [
        (name, np.int64)
        for name in ("capacity", "scope", "foresee_upkeep", "weekday", "observation", "full_state")
    ],
    align=True,
)
"""The configuration's numbers as the kernel reads them. `captive_arrivals`: share of captives among those who
arrive; `breakdown_cost`: reward that a bus loses by running out of fuel; `low_occupancy`: occupancy under
which e punishes, 0 for none; `observation`: 0 paper, 1 published, 2 control; `scope`:
PAY_TEAM, PAY_LINE or PAY_OWN."""

SLOT = np.dtype(
    [
        ("phase", np.int64),
        ("block", np.int64),  # index of the current (or next) trip among the slot's
        ("trip", np.int64),
        ("pattern", np.int64),
        ("call", np.int64),  # the call it stands at or has left
        ("load", np.int64),
        ("breakdowns", np.int64),
        ("since", np.float64),  # when the load last changed
        ("left", np.float64),  # departure from `call`
        ("trip_left", np.float64),
        ("held", np.float64),  # seconds held at this stop
        ("trip_factor", np.float64),
        ("fuel", np.float64),
        ("uptime", np.float64),
        ("worked", np.float64),  # up to when fuel and uptime are charged
        ("hazard", np.float64),  # cumulated since the last breakdown
        ("hazard_limit", np.float64),
        ("headway_ratio", np.float64),  # of the last departure
        ("place", np.float64),  # nominal seconds along the pattern
        ("ahead", np.float64),  # spacing over target headway, NaN without a neighbour
        ("behind", np.float64),
        ("leader", np.int64),  # slot of the bus ahead on the way, -1 without one
        ("counted", np.int64),  # 1: scheduled in service, counts for c; 2: away or broken
        ("regularity", np.float64),
        ("upkeep_ahead", np.float64),  # potential of `foresee_upkeep`
    ],
    align=True,
)
"""State of a slot."""

QUEUE = np.dtype(
    [
        ("next_arrival", np.float64),
        ("drawn", np.int64),  # arrivals drawn so far
        ("waiting", np.int64),
        ("denied", np.int64),  # the first so many of the queue were left behind by a full bus
        ("hour", np.int64),
        ("hour_factor", np.float64),
        ("last_departure", np.float64),
    ],
    align=True,
)
"""State of the queue at a call."""

PATTERN = np.dtype([("last_finish", np.float64), ("next_trip", np.int64)], align=True)
"""Last arrival at the pattern's end, and the first of its trips that has not left."""

LINE = np.dtype(
    [
        (name, np.float64)
        for name in [
            "service",
            "efficiency",
            "maintenance",
            "regularity",
            "alive",
            "on_route",
            "counted",
            "waiting",
        ]
    ],
    align=True,
)
"""A line in the last control interval: the four components of its reward, and what they were means of."""

COUNTS = [
    "arrived",
    "boarded",
    "alighted",
    "requeued",
    "lost",
    "denied",
    "visits",
    "breakdowns",
    "headways",
    "bunched",
    "loads",
]
SUMS = [
    "captive_boarded",
    "captive_wait",
    "wait",
    "headway_ratio",
    "headway_ratio_squared",
    "headway",
    "headway_squared",
    "headway_target",
    "load",
    "ride",
    "fuel",
    "held",
    "reward",
    "service",
    "efficiency",
    "maintenance",
    "regularity",
]

DAY = np.dtype(
    [("seed", np.uint64), ("key", np.uint64), ("episode", np.int64), ("tick", np.int64)]
    + [("now", np.float64), ("demand_factor", np.float64)]
    + [(name, np.int64) for name in COUNTS]
    + [(name, np.float64) for name in SUMS],
    align=True,
)
"""State and accounts of a copy's day."""


class World(NamedTuple):
    """The state of C copies: all of it, so that a copy of these arrays is a snapshot."""

    days: NDArray[Any]
    """(C,) DAY"""
    slots: NDArray[Any]
    """(C, N) SLOT"""
    event_time: NDArray[np.float64]
    """(C, N) next event of each slot, s"""
    queues: NDArray[Any]
    """(C, Q) QUEUE"""
    arrived_at: NDArray[np.float64]
    """(C, storage) arrival times of those who wait, call after call, first come first"""
    leaves_at: NDArray[np.float64]
    """(C, storage) when each takes the competing service; infinite for captives"""
    patterns: NDArray[Any]
    """(C, P) PATTERN"""
    lines: NDArray[Any]
    """(C, L) LINE"""
    departed: NDArray[np.bool_]
    """(C, J) the trip has left"""
    trip_time: NDArray[np.float64]
    """(C, J) duration of finished trips, s; NaN before"""
    congestion: NDArray[np.float64]
    """(C, B + 1) travel-time factor of the network at the edges of the bins"""
    waits: NDArray[np.uint32]
    """(C, WAIT_BINS)"""
    loads: NDArray[np.uint32]
    """(C, capacity + 1) departures by load"""


class Trace(NamedTuple):
    """What happened at each call of each trip of the day, T = trips x their calls, trip after trip; or
    nothing, with T = 0. It is not part of a snapshot."""

    first: NDArray[np.int64]
    """(J + 1,) first entry of each trip"""
    arrived: NDArray[np.float64]
    """(C, T) s; NaN where the trip has not come, and at its first call"""
    left: NDArray[np.float64]
    """(C, T) s; NaN where it has not left, and at its last call"""
    boarded: NDArray[np.float64]
    """(C, T) passengers"""
    load: NDArray[np.float64]
    """(C, T) passengers aboard on leaving; NaN where `left` is"""


class Outputs(NamedTuple):
    """What a step fills, in the shapes of `headway.contracts`; `acting` is also read back by the rules."""

    observations: NDArray[np.float32]
    states: NDArray[np.float32]
    alive: NDArray[np.bool_]
    masks: NDArray[np.bool_]
    rewards: NDArray[np.float32]
    acting: NDArray[np.bool_]
    ended: NDArray[np.bool_]
    final_observations: NDArray[np.float32]
    final_states: NDArray[np.float32]
    metrics: NDArray[np.float64]


OBSERVATION_SIZES = {"paper": 4, "published": 8, "control": 29}
LINE_STATE = 10
"""State features of one line."""
DAY_STATE = 3
"""State features of the day: progress, and the hour as sine and cosine."""

METRICS = [
    "mean_wait_min",
    "p95_wait_min",
    "captive_wait_min",
    "excess_wait_min",
    "headway_cv",
    "bunched_share",
    "denied_boardings",
    "boardings",
    "lost_share",
    "occupancy_mean",
    "occupancy_p95",
    "in_vehicle_min",
    "trip_time_spread_min",
    "held_min_per_trip",
    "breakdowns",
    "service_visits",
    "fuel_used",
    "reward_service",
    "reward_efficiency",
    "reward_maintenance",
    "reward_regularity",
    "team_reward",
]
"""Names of the episode metrics; `meanings` says what they are."""
