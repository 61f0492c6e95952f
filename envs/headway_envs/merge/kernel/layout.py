"""The records that the kernel works on.

Axes: L lanes, C copies, N slots of CAVs, V vehicles and obstacles of a copy at most. Lengths in m, times
in s, speeds in m/s, angles in rad. x runs along the highway, y to its right.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Record = Any
"""One element of an array of LANE, CAR, EPISODE or SETTINGS; fields are attributes in compiled code."""

LEFT, IDLE, RIGHT, FASTER, SLOWER = 0, 1, 2, 3, 4
"""Actions."""
AS_HUMAN = 5
"""What the rule `idm_mobil` asks for instead of an action: this step the vehicle drives as a human would."""
ACTIONS = 5

SUBSTEPS = 3
"""Simulation steps in a step of the agents."""
STEP_S = 1.0 / 15.0
"""Simulation step, s."""

CAR_LENGTH, CAR_WIDTH, OBSTACLE_SIZE = 5.0, 2.0, 2.0
LANE_WIDTH = 4.0
SLOWEST, SPEED_STEP, FASTEST_INDEX = 10.0, 5.0, 4
"""Target speeds of a CAV: 10, 15, 20, 25, 30 m/s, by index."""
RAMP_END = 420.0
"""Where the ramp lanes end, m."""
MERGING_LENGTH = 100.0
"""Of the last stretch of the ramp lanes, where they lead alongside, as rewards and priorities have it, m."""
SIGHT = 60.0
"""Gaps to the vehicle ahead count up to here, m."""

LANE = np.dtype(
    [
        ("x", np.float64),
        ("y", np.float64),
        ("length", np.float64),
        ("amplitude", np.float64),  # of a sine about y; 0 where straight
        ("pulsation", np.float64),
        ("phase", np.float64),
        ("beside_from", np.float64),  # x from which `right` is beside it
        ("first", np.int64),  # the leftmost lane of its road
        ("last", np.int64),  # the rightmost
        ("successor", np.int64),  # the lane that goes on; itself where none does
        ("closed", np.int64),  # nobody may change to it
        ("merging", np.int64),  # a ramp lane beside the highway, which ends
        ("left", np.int64),  # lanes whose vehicles are next to one here, -1 for none; its own is one of them
        ("right", np.int64),
    ],
    align=True,
)
"""A lane. Distances along it are along x, on a curved one, too."""

CAR = np.dtype(
    [
        (name, np.float64)
        for name in [
            "x",
            "y",
            "heading",
            "cosine",  # of the heading
            "sine",
            "speed",
            "target_speed",
            "desired_speed",  # as a human driver
            "timer",  # since the last thought of changing lanes
            "steering",
            "acceleration",
            "push_x",  # displacement at the next step by vehicles about to meet
            "push_y",
        ]
    ]
    + [
        (name, np.int64)
        for name in [
            "lane",
            "target_lane",
            "pushed",
            "crashed",
            "human",  # drives itself in this step
            "from_ramp",
            "merged",  # has passed the end of the ramp on the highway
        ]
    ],
    align=True,
)
"""A vehicle, or an obstacle: the CAVs of an episode stand first, then the HDVs, then the obstacles."""

EPISODE = np.dtype(
    [("seed", np.uint64), ("key", np.uint64)]
    + [(name, np.int64) for name in ("number", "step", "cavs", "cars", "crash", "interventions")]
    + [(name, np.float64) for name in ("reward", "speed", "least_speed", "least_gap", "least_headway")],
    align=True,
)
"""State and accounts of a copy's episode; `cars`: CAVs and HDVs; `crash`: a CAV has crashed."""

SETTINGS = np.dtype(
    [
        (name, np.float64)
        for name in [
            "weight_collision",
            "weight_speed",
            "weight_ramp_end",
            "weight_spacing",
            "headway_s",
            "least_change_speed",
            "least_gain",
            "most_braking",
            "gain_where_equal",
        ]
    ]
    + [
        (name, np.int64)
        for name in [
            "scope",
            "fewest_cavs",
            "most_cavs",
            "fewest_hdvs",
            "most_hdvs",
            "steps",
            "ramp_lanes",
            "supervisor",
            "steering_from_slip",
            "follow_both_lanes",
            "whole_outlines",
            "ends_within_step",
            "time_is_terminal",
            "one_action_ahead",
        ]
    ],
    align=True,
)
"""The configuration's numbers as the kernel reads them; `scope`: 0 global, 1 regional, 2 own."""


class Network(NamedTuple):
    """The road, which all copies share."""

    lanes: NDArray[Any]
    """(L,) LANE, in the order in which the closest is looked for; lanes of a road stand together"""
    near: NDArray[np.bool_]
    """(L, L): who is on the second lane is ahead of or behind those on the first"""
    spawn: NDArray[np.int64]
    """(1 + number of ramp lanes,) the lanes on which vehicles begin, the highway's first"""
    obstacles: NDArray[np.float64]
    """(K, 2) their centres"""


class World(NamedTuple):
    """The state of C copies: all of it, so that a copy of these arrays is a snapshot."""

    episodes: NDArray[Any]
    """(C,) EPISODE"""
    cars: NDArray[Any]
    """(C, V) CAR"""


class Workspace(NamedTuple):
    """Memory to work in, in which nothing is kept from step to step."""

    ghosts: NDArray[Any]
    """(2,) CAR: the vehicle whose way is foreseen, and one it may meet there"""
    ways: NDArray[np.float64]
    """(4, FORESEEN, 4): x, y, cosine and sine of the neighbours, foreseen"""
    priorities: NDArray[np.float64]
    """(N,)"""
    allowed: NDArray[np.bool_]
    """(ACTIONS,)"""
    own: NDArray[np.float32]
    """(N,): what each CAV would be paid alone"""


FORESEEN = 15
"""Simulation steps that the supervisor looks ahead."""


class Outputs(NamedTuple):
    """What a step fills, in the shapes of `headway.contracts`."""

    observations: NDArray[np.float32]
    states: NDArray[np.float32]
    alive: NDArray[np.bool_]
    masks: NDArray[np.bool_]
    rewards: NDArray[np.float32]
    acting: NDArray[np.bool_]
    terminated: NDArray[np.bool_]
    truncated: NDArray[np.bool_]
    ended: NDArray[np.bool_]
    final_observations: NDArray[np.float32]
    final_states: NDArray[np.float32]
    final_episodes: NDArray[Any]
    """(C,) EPISODE: as the last episode ended; for pictures"""
    final_cars: NDArray[Any]
    """(C, V) CAR"""
    metrics: NDArray[np.float64]


SEEN = 4
"""Vehicles that a CAV observes."""
OBSERVATION_SIZE = 5 * (1 + SEEN)
CAR_STATE = 7
"""State features of a vehicle; one more tells the time."""

METRICS = [
    "reward",
    "crash_rate",
    "merge_rate",
    "ramp_merge_rate",
    "hdv_merge_rate",
    "mean_speed_ms",
    "min_speed_ms",
    "min_gap_m",
    "min_headway_s",
    "steps",
    "interventions",
]
"""Names of the episode metrics; `meanings` says what they are."""
