"""Records of the kernel. They are few, because each array passed to compiled code costs time.

Axes: V vehicles, N slots, L = 16 links (paths through the junction), D observation, S state.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from headway_envs.intersection.config import TERMS

Floats = NDArray[np.float64]
Whole = NDArray[np.int64]
Record = Any
"""The element of an array (1,) of one of the dtypes below. Compiled code reads fields as attributes."""

NUM_LINKS = 16
"""L: number of paths through the junction, SUMO's links."""
NUM_LANES = 8
"""Number of entry lanes; a link belongs to lane link // 2."""
MAX_VEHICLES = 512
"""Maximum number of vehicles; the roads have room for fewer: 16 lanes of 200 m, 7.5 m per standing
vehicle."""
PAPER_SIZE = 6
PATH_SIZE = 8
NEAR_SIZE = 4
NEIGHBOURS = 4
"""Number of vehicles on conflicting paths in an extended observation."""
NEIGHBOUR_SIZE = 6
EXTENDED_SIZE = PAPER_SIZE + PATH_SIZE + NEAR_SIZE + NEIGHBOURS * NEIGHBOUR_SIZE
CELLS = 4
"""Number of cells of 50 m per approach in the state."""
STATE_SIZE = 4 * (3 * CELLS + 2 + 2) + 2
REWARD_PAPER, REWARD_TEAM, REWARD_OWN = range(3)
"""Kinds of reward: the paper's, the scaled one of the team, or the scaled one of each AV."""

CROSSING = np.dtype(
    [
        ("link_length", np.float64, NUM_LINKS),  # length inside the junction, m
        ("foes", np.int8, (NUM_LINKS, NUM_LINKS)),  # 1: the two links cross or merge
        ("yields", np.int8, (NUM_LINKS, NUM_LINKS)),  # 1: the first link yields to the second
        ("weights", np.float64, len(TERMS)),  # weights of the scaled terms
        ("total_length", np.float64),
        ("extended", np.int64),  # 1: extended observations
        ("reward_kind", np.int64),
    ],
    align=True,
)
"""Constants of an environment."""

SUMS = (
    "steps_all", "steps_av", "steps_hdv", "vehicles", "speed", "speed_av", "speed_hdv", "acceleration_av",
    "acceleration_hdv", "hardest_braking_av", "hardest_braking_hdv", "fuel", "standing", "team_return",
    "paper_return",
)  # fmt: skip
"""Sums over steps for the metrics: steps with vehicles of a kind, means over these vehicles per step, number
of vehicles, and rewards. `hardest_braking_*` are maxima instead."""

ACCOUNT = np.dtype(
    [
        ("state", np.float32, STATE_SIZE),
        ("scaled", np.float64, len(TERMS)),  # terms in [-1, 1], in the order of TERMS
        ("paper", np.float64, len(TERMS)),  # the paper's terms with their gains
        *((name, np.float64) for name in SUMS),  # sums over the episode
        ("terms", np.float64, len(TERMS)),  # sums of the terms of the reward in use
        ("present", np.float64, 4),  # sum of AVs present, by approach
    ],
    align=True,
)
"""State and reward terms of the step, and sums of the episode."""

SCRATCH = np.dtype(
    [
        ("first", np.int64, NUM_LINKS),  # row of the first vehicle before the stop line; -1: none
        ("inside", np.int64, MAX_VEHICLES + 1),  # rows of the vehicles inside the junction, then -1
        ("arrival", np.float64, NEIGHBOURS),  # time until each ranked vehicle arrives, s
        ("ranked", np.int64, NEIGHBOURS),  # rows of the next vehicles on conflicting paths; -1: none
    ],
    align=True,
)
"""Scratch space for the search for vehicles on conflicting paths."""


class Traffic(NamedTuple):
    """All vehicles, in rows 0 to V - 1 of longer arrays: views of the fields of a TRAFFIC record.
    Compiled code reads the record itself, by the same names."""

    position: Floats
    """Position of the front along the path, m; the stop line is at ROAD_M."""
    speed: Floats
    """Current speed, m/s."""
    before: Floats
    """Speed in the previous step, m/s."""
    fuel: Floats
    """Fuel rate, ml/s."""
    offset: Floats
    """Position at entry minus the distance driven by then, m."""
    link: Whole
    slot: Whole
    """Slot of an AV; -1: driven by SUMO."""
    around: Floats
    """(V, 4) row of the leader (-1: none) and gap to it, row of the follower (-1: none) and gap to it, m;
    valid for vehicles with a slot."""

    @classmethod
    def of(cls, records: NDArray[np.void]) -> "Traffic":
        """Return views of an array (1,) of TRAFFIC."""
        return cls(*(records[name][0] for name in cls._fields))


TRAFFIC = np.dtype(
    [(name, np.float64, MAX_VEHICLES) for name in ("position", "speed", "before", "fuel", "offset")]
    + [(name, np.int64, MAX_VEHICLES) for name in ("link", "slot")]
    + [("around", np.float64, (MAX_VEHICLES, 4))]
)


class Slots(NamedTuple):
    """Observations, presence and rewards of one intersection's N slots."""

    observations: NDArray[np.float32]
    """(N, D) observations; rows of empty slots are 0."""
    alive: NDArray[np.bool_]
    """(N,) whether an AV holds the slot now."""
    acting: NDArray[np.bool_]
    """(N,) whether the slot's AV was present when the current action was chosen."""
    rewards: NDArray[np.float32]
    """(N,) rewards summed over the steps of the current action."""

    @classmethod
    def empty(cls, slots: int, size: int) -> "Slots":
        """Return zeroed arrays for `slots` slots and observations of `size` numbers."""
        return cls(
            observations=np.zeros((slots, size), np.float32),
            alive=np.zeros(slots, np.bool_),
            acting=np.zeros(slots, np.bool_),
            rewards=np.zeros(slots, np.float32),
        )


class StepEvents(NamedTuple):
    """Events of a step that the kernel needs besides positions and speeds."""

    arrived: int = 0
    """Vehicles that left at their exit."""
    crashes: int = 0
    """Pairs of vehicles."""
    lane_changes: int = 0
    """Lane changes of AVs."""
    outflow_vph: float = 0.0
    """Vehicles that left since the start of the episode, per hour."""
    pending: int = 0
    """Vehicles waiting to enter."""
    progress: float = 0.0
    """Elapsed share of the episode."""
