"""Records and arrays of the kernel.

Axes: L lanes, C copies, N slots of connected automated vehicles
(CAVs), V maximum number of vehicles and obstacles of a copy. Lengths in m,
times in s, speeds in m/s, angles in rad. x runs along the highway, y to its right.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Record = Any
"""One element of an array of LANE, CAR, EPISODE or SETTINGS. Compiled code reads fields as attributes."""

LEFT, IDLE, RIGHT, FASTER, SLOWER = 0, 1, 2, 3, 4
"""Actions."""
AS_HUMAN = 5
"""Action of the rule `idm_mobil`, outside the action space: the vehicle drives as a human in this step."""
ACTIONS = 5

SUBSTEPS = 3
"""Number of simulation steps per step of the agents."""
STEP_S = 1.0 / 15.0
"""Simulation step, s."""

CAR_LENGTH, CAR_WIDTH, OBSTACLE_SIZE = 5.0, 2.0, 2.0
LANE_WIDTH = 4.0
MIN_TARGET_SPEED, SPEED_STEP, FASTEST_INDEX = 10.0, 5.0, 4
"""Target speeds of a CAV: 10, 15, 20, 25, 30 m/s, by index."""
RAMP_END = 420.0
"""x at which the ramp lanes end, m."""
MERGING_LENGTH = 100.0
"""Length of the ramp lanes beside the highway, in rewards and priorities, m."""
MAX_GAP = 60.0
"""Maximum gap to the vehicle ahead; longer ones are cut, m."""

LANE = np.dtype(
    [
        ("x", np.float64),
        ("y", np.float64),
        ("length", np.float64),
        ("amplitude", np.float64),  # of a sine about y; 0: straight lane
        ("pulsation", np.float64),
        ("phase", np.float64),
        ("beside_from", np.float64),  # x from which lane `right` runs beside this one
        ("first", np.int64),  # leftmost lane of the same road
        ("last", np.int64),  # rightmost lane of the same road
        ("successor", np.int64),  # next lane; the lane itself if there is none
        ("closed", np.int64),  # 1: no vehicle may change to it
        ("merging", np.int64),  # 1: ramp lane beside the highway, which ends
        ("left", np.int64),  # with `right`: the pair of neighbouring lanes, one of them this one; -1: none
        ("right", np.int64),
    ],
    align=True,
)
"""A lane. Distances along it are measured along x, also on a curved lane."""

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
            "desired_speed",  # of a human driver
            "timer",  # time since the last lane-change decision
            "steering",
            "acceleration",
            "push_x",  # displacement at the next step, caused by an imminent contact
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
            "human",  # 1: driven by IDM and MOBIL in this step
            "from_ramp",
            "merged",  # 1: has passed the end of the ramp on the highway
        ]
    ],
    align=True,
)
"""A vehicle or obstacle. Order in an episode: CAVs, HDVs, obstacles."""

EPISODE = np.dtype(
    [("seed", np.uint64), ("key", np.uint64)]
    + [(name, np.int64) for name in ("number", "step", "cavs", "cars", "crash", "interventions")]
    + [(name, np.float64) for name in ("reward", "speed", "min_speed", "min_gap", "min_headway")],
    align=True,
)
"""State and totals of a copy's episode. `cars`: number of CAVs and HDVs; `crash`: 1 after a CAV's crash."""

SETTINGS = np.dtype(
    [
        (name, np.float64)
        for name in [
            "weight_collision",
            "weight_speed",
            "weight_ramp_end",
            "weight_spacing",
            "headway_s",
            "min_change_speed",
            "min_gain",
            "max_braking",
            "tie_gain",
        ]
    ]
    + [
        (name, np.int64)
        for name in [
            "scope",
            "min_cavs",
            "max_cavs",
            "min_hdvs",
            "max_hdvs",
            "steps",
            "ramp_lanes",
            "supervisor",
            "steering_from_slip",
            "follow_both_lanes",
            "exact_outlines",
            "ends_within_step",
            "time_is_terminal",
            "single_action_ahead",
        ]
    ],
    align=True,
)
"""Numbers of the configuration that the kernel reads. `scope`: 0 global, 1 regional, 2 own."""


class Network(NamedTuple):
    """Road network, shared by all copies."""

    lanes: NDArray[Any]
    """(L,) LANE records, in the search order of `closest_lane`; lanes of a road are adjacent"""
    near: NDArray[np.bool_]
    """(L, L) true if vehicles on the second lane can be ahead of or behind those on the first"""
    spawn: NDArray[np.int64]
    """(1 + number of ramp lanes,) lanes on which vehicles start, that of the highway first"""
    obstacles: NDArray[np.float64]
    """(number of ramp lanes, 2) centres of the obstacles, x and y"""


class World(NamedTuple):
    """State of C copies. It is complete: copies of these arrays make up a snapshot."""

    episodes: NDArray[Any]
    """(C,) EPISODE records"""
    cars: NDArray[Any]
    """(C, V) CAR records"""


class Workspace(NamedTuple):
    """Scratch arrays, without content between steps."""

    ghosts: NDArray[Any]
    """(2,) CAR records: the predicted vehicle, and one that it may collide with"""
    predicted: NDArray[np.float64]
    """(4, FORESEEN, 4): predicted x, y, cosine and sine of the neighbours"""
    priorities: NDArray[np.float64]
    """(N,) priorities of the supervisor, lowest first"""
    allowed: NDArray[np.bool_]
    """(ACTIONS,) action mask of one CAV"""
    own: NDArray[np.float32]
    """(N,) own reward of each CAV"""


PREDICTED_STEPS = 15
"""Prediction horizon of the supervisor, simulation steps."""


class Outputs(NamedTuple):
    """Arrays that a step fills, in the shapes of `headway.contracts`."""

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
    """(C,) EPISODE records at the end of the last episode, for pictures"""
    final_cars: NDArray[Any]
    """(C, V) CAR records at the end of the last episode, for pictures"""
    metrics: NDArray[np.float64]


OBSERVED_VEHICLES = 4
"""Maximum number of other vehicles that a CAV observes."""
OBSERVATION_SIZE = 5 * (1 + OBSERVED_VEHICLES)
CAR_STATE = 7
"""Number of state features per vehicle; the state ends with one feature for the time."""
