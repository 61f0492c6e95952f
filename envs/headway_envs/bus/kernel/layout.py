"""Records and arrays of the kernel.

Axes: L lines, P patterns, N slots, J trips, C copies; Q calls (positions of all patterns, one pattern after
the other), K hour knots (values at half past each hour, from FIRST_KNOT_HOUR on), B quarter hours of the
service day. Times are in seconds after midnight.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Record = Any
"""One element of an array of SETTINGS, SLOT, QUEUE, CALL, LINE or DAY. Compiled code reads fields as
attributes."""

FIRST_KNOT_HOUR = 3
KNOTS = 25
"""Number of hour knots: 03:30, 04:30, ... 27:30."""
KNOT_HOURS = np.arange(FIRST_KNOT_HOUR, FIRST_KNOT_HOUR + KNOTS)
KNOT_S: NDArray[np.float64] = np.asarray(KNOT_HOURS * 3600.0 + 1800.0, np.float64)
"""(K,) hours of the knots, and their times, s."""
BIN_S = 900.0
"""Width of a bin of arrival rates and of congestion, s."""
PERIOD_ENDS_S = (9 * 3600.0, 15 * 3600.0, 20 * 3600.0)
"""Ends of the first three of the four periods of `Network.alighting`, s."""
WAIT_BINS = 10800
"""Number of one-second bins of the histogram of waits. The last bin also holds all longer waits."""

DEPOT, TERMINAL, DISPATCHED, DRIVING, STANDING, AWAY, BROKEN = 0, 1, 2, 3, 4, 5, 6
"""Phases of a slot. TERMINAL: before a trip, decides; DISPATCHED: leaves after the dispatch delay; STANDING:
at a stop, boards, then decides; AWAY: at the service centre; BROKEN: broken down, not yet towed."""

WAIT, MOVE, SERVICE_CENTER = 0, 1, 2
"""Actions."""

SKIP_NEXT, LIMIT_NEXT = -1, -2
"""With the setting `holding`, actions besides holding times: leave at once, and let no more passengers board
at the next stop, or only the share `boarding_limit` of those who wait."""

SCOPE_TEAM, SCOPE_LINE, SCOPE_OWN = 0, 1, 2
"""Values of the setting `scope`: each slot receives the reward of the team, of its line, or of its own
bus."""


class Network(NamedTuple):
    """Part of the simulation that all copies share: geometry, timetable, mean travel times and demand."""

    line_slots: NDArray[np.int64]
    """(L + 1,) first slot of each line"""
    line_patterns: NDArray[np.int64]
    """(L + 1,) first pattern of each line"""
    pattern_calls: NDArray[np.int64]
    """(P + 1,) first call of each pattern"""
    trip_pattern: NDArray[np.int64]
    """(J,) pattern of each trip; trips are sorted by pattern, then by departure"""
    trip_departure: NDArray[np.float64]
    """(J,) scheduled departure, s"""
    trip_deadhead: NDArray[np.float64]
    """(J,) driving time from the end of the slot's previous trip, s"""
    trip_work_left: NDArray[np.float64]
    """(J,) planned driving time of this trip and of the slot's following trips up to its next stay at the
    depot, s"""
    slot_trips: NDArray[np.int64]
    """(J,) trips of slot 0 in order, then of slot 1, ..."""
    slot_first: NDArray[np.int64]
    """(N + 1,) position of each slot's first trip in `slot_trips`"""
    slot_line: NDArray[np.int64]
    """(N,) line of each slot"""
    running: NDArray[np.float64]
    """(Q, K) mean running time to the next call without dwell, s"""
    nominal: NDArray[np.float64]
    """(Q, K) mean time from the first call of the pattern, with dwell, s"""
    noise_sd: NDArray[np.float64]
    """(Q,) sd of the log of the link's travel-time factor"""
    alighting: NDArray[np.float64]
    """(Q, 4) share of the load that alights: before 9 h, 9-15 h, 15-20 h, later"""
    arrival_rate: NDArray[np.float64]
    """(Q, B) arriving passengers per s, including those who may leave with the competing service"""
    boarding_rate: NDArray[np.float64]
    """(Q, B) boarding passengers per s under a regular service"""
    regular_waiting: NDArray[np.float64]
    """(L, B) mean number of waiting passengers under a regular service"""
    target: NDArray[np.float64]
    """(P, K) target headway, s"""
    slowness: NDArray[np.float64]
    """(Q,) factor on the travel time to the next call during the hour of the setting `slow_s`"""
    detour: NDArray[np.float64]
    """(Q,) driving time to the nearest service centre, one way, s"""
    line_trip: NDArray[np.float64]
    """(L,) nominal time of the line's longest trip, at the time of day when it takes longest, s"""
    line_detour: NDArray[np.float64]
    """(L,) smallest `detour` of the calls where the line's trips begin, s"""
    queue_first: NDArray[np.int64]
    """(Q + 1,) position of each call's queue in the queue storage of a copy"""


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
            "slow_s",
            "breakdown_s",
            "late_s",
            "noncompliant_share",
            "boarding_limit",
        ]
    ]
    + [
        (name, np.int64)
        for name in [
            "capacity",
            "scope",
            "scale_service",
            "foresee_upkeep",
            "weekday",
            "observation",
            "full_state",
            "breakdown_bus",
            "late_bus",
            "holding",
            "control_every",
            "skip_action",
            "limit_action",
        ]
    ],
    align=True,
)
"""Numbers of the configuration that the kernel reads. `captive_arrivals`: share of captive passengers among
arrivals; `breakdown_cost`: reward that a bus loses by running out of fuel; `low_occupancy`: occupancy below
which e is penalised, 0 if it is not; `observation`: 0 paper, 1 published, 2 control; `scope`: SCOPE_TEAM,
SCOPE_LINE or SCOPE_OWN; `slow_s`: start of the hour of slow links, infinite without; `breakdown_bus`,
`late_bus`: slots, -1 without; `holding`: actions are holding times, ms, SKIP_NEXT or LIMIT_NEXT,
instead of WAIT, MOVE and SERVICE_CENTER; `skip_action`, `limit_action`: places of the latter two among the
action masks, -1 without."""

SLOT = np.dtype(
    [
        ("phase", np.int64),
        ("block", np.int64),  # position of the current or next trip in `slot_trips`
        ("trip", np.int64),
        ("pattern", np.int64),
        ("call", np.int64),  # call at which the bus stands or which it left last
        ("load", np.int64),
        ("breakdowns", np.int64),
        ("since", np.float64),  # time of the last change of load
        ("left", np.float64),  # time of departure from `call`
        ("trip_left", np.float64),  # time of departure on the trip
        ("held", np.float64),  # holding time at this stop, s
        ("complies", np.bool_),  # whether the driver complies with holding
        ("order", np.int64),  # at this stop: SKIP_NEXT, LIMIT_NEXT or, if 0, serve it
        ("next_order", np.int64),  # at the next stop
        ("trip_factor", np.float64),
        ("fuel", np.float64),
        ("uptime", np.float64),
        ("worked", np.float64),  # time up to which fuel and uptime are charged
        ("hazard", np.float64),  # cumulative breakdown hazard since the last breakdown
        ("hazard_limit", np.float64),  # hazard at which the bus breaks down
        ("headway_ratio", np.float64),  # headway over target headway, at the last departure
        ("place", np.float64),  # position: nominal time from the first call of the pattern, s
        ("ahead", np.float64),  # spacing over target headway, NaN without a neighbour
        ("behind", np.float64),
        ("leader", np.int64),  # slot of the bus ahead on the route, -1 without one
        ("counted", np.int64),  # role in the regularity c: see `spacing.LEFT_OUT`
        ("regularity", np.float64),  # c of the bus
        ("upkeep_ahead", np.float64),  # potential of `foresee_upkeep`
    ],
    align=True,
)
"""State of one slot. Spacings `ahead` and `behind` are divided by the target headway; NaN without a
neighbour."""

QUEUE = np.dtype(
    [
        ("next_arrival", np.float64),
        ("drawn", np.int64),  # number of arrivals drawn so far
        ("waiting", np.int64),  # number of waiting passengers
        ("denied", np.int64),  # number of passengers at the queue's head left behind by a bus
        ("hour", np.int64),  # hour of `hour_factor`
        ("hour_factor", np.float64),  # random factor on the arrival rate
        ("last_departure", np.float64),
    ],
    align=True,
)
"""State of the queue at one call."""

CALL = np.dtype(
    [
        ("headway", np.float64),  # sum of headways, s
        ("headway_squared", np.float64),
        ("headways", np.uint32),
        ("arrivals", np.uint32),
        ("load", np.uint32),  # sum of the loads of arriving buses
        ("load_squared", np.uint32),
        ("skipped", np.bool_),  # whether the last bus to leave the stop before skips this one
    ],
    align=True,
)
"""Totals of the day at one call, and whether it was skipped last. Not in QUEUE, which every control interval
scans."""

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
"""State of one line after a control interval: components of its reward, and the numbers of buses and
passengers that they are computed from."""

COUNTS = [
    "arrived",
    "boarded",
    "alighted",
    "requeued",
    "lost",
    "denied",
    "skipped",
    "limited",
    "visits",
    "breakdowns",
    "headways",
    "bunched",
    "bunching_events",
    "loads",
]
"""Integer totals of a day, in DAY."""
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
    "queueing",
    "schedule_deviation",
    "reward",
    "service",
    "efficiency",
    "maintenance",
    "regularity",
]
"""Real-valued totals of a day, in DAY."""

DAY = np.dtype(
    [("seed", np.uint64), ("key", np.uint64), ("episode", np.int64), ("tick", np.int64)]
    + [("now", np.float64), ("demand_factor", np.float64)]
    + [("breakdown_bus", np.int64)]  # slot of the planned breakdown, -1 once it has happened
    + [(name, np.int64) for name in COUNTS]
    + [(name, np.float64) for name in SUMS],
    align=True,
)
"""State and totals of the day of one copy."""


class World(NamedTuple):
    """State of C copies. It is complete: copies of these arrays make up a snapshot."""

    days: NDArray[Any]
    """(C,) DAY records"""
    slots: NDArray[Any]
    """(C, N) SLOT records"""
    event_time: NDArray[np.float64]
    """(C, N) time of each slot's next event, s"""
    queues: NDArray[Any]
    """(C, Q) QUEUE records"""
    calls: NDArray[Any]
    """(C, Q) CALL records"""
    arrived_at: NDArray[np.float64]
    """(C, storage) arrival times of waiting passengers, one call after the other, first come first"""
    leaves_at: NDArray[np.float64]
    """(C, storage) time at which each waiting passenger takes the competing service; infinite for captive
    passengers"""
    last_finish: NDArray[np.float64]
    """(C, P) time of the last arrival at the end of each pattern, s; -1 before the first"""
    lines: NDArray[Any]
    """(C, L) LINE records"""
    departed: NDArray[np.bool_]
    """(C, J) whether the trip has left"""
    trip_time: NDArray[np.float64]
    """(C, J) duration of finished trips, s; else NaN"""
    congestion: NDArray[np.float64]
    """(C, B + 1) travel-time factor of the network at the edges of the bins"""
    waits: NDArray[np.uint32]
    """(C, WAIT_BINS) histogram of waits"""
    loads: NDArray[np.uint32]
    """(C, capacity + 1) histogram of loads at departures"""


class Trace(NamedTuple):
    """Times and passengers at each call of each trip of the day, one trip after the other: T entries per
    copy, or none without tracing. Not part of a snapshot."""

    first: NDArray[np.int64]
    """(J + 1,) first entry of each trip"""
    arrived: NDArray[np.float64]
    """(C, T) arrival, s; NaN at the first call of a trip and where the bus has not arrived"""
    left: NDArray[np.float64]
    """(C, T) departure, s; NaN at the last call of a trip and where the bus has not left"""
    boarded: NDArray[np.float64]
    """(C, T) boarded passengers"""
    load: NDArray[np.float64]
    """(C, T) passengers aboard at departure; NaN where `left` is NaN"""


class Outputs(NamedTuple):
    """Arrays that a step fills, in the shapes of `headway.contracts`."""

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


OBSERVATION_SIZES = {"paper": 4, "published": 8, "control": 29, "network": 33}
LINE_STATE = 10
"""Number of state features per line."""
DAY_STATE = 3
"""Number of state features of the day: progress, and the time of day as sine and cosine."""
