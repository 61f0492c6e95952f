"""What the kernel works on: a few blocks of memory, since each array that is handed over takes its time.

Axes: V vehicles, N slots, L = 16 links (ways through the junction), D, S.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from headway_envs.intersection.config import TERMS

Floats = NDArray[np.float64]
Whole = NDArray[np.int64]
Record = Any
"""The element of an array (1,) of one of the dtypes below; fields are attributes in compiled code."""

WAYS = 16
"""Through the junction: L, SUMO's links."""
LANES = 8
"""On which vehicles come; a link is of lane link // 2."""
MOST_VEHICLES = 512
"""More than have room on the crossing's roads: lanes of 16 x 200 m, 7.5 m a vehicle that stands."""
PAPER_SIZE = 6
WAY_SIZE = 8
NEAR_SIZE = 4
NEIGHBOURS = 4
"""Vehicles on crossing ways that an extended observation shows."""
NEIGHBOUR_SIZE = 6
EXTENDED_SIZE = PAPER_SIZE + WAY_SIZE + NEAR_SIZE + NEIGHBOURS * NEIGHBOUR_SIZE
CELLS = 4
"""Of 50 m on each approach, in the state."""
STATE_SIZE = 4 * (3 * CELLS + 2 + 2) + 2
PAY_PAPER, PAY_TEAM, PAY_OWN = range(3)
"""Which reward: the paper's, or the scaled one, the team's or each AV's own."""

CROSSING = np.dtype(
    [
        ("link_length", np.float64, WAYS),  # m inside the junction
        ("foes", np.int8, (WAYS, WAYS)),  # 1: these cross or merge
        ("yields", np.int8, (WAYS, WAYS)),  # 1: the first must let the second go first
        ("weights", np.float64, len(TERMS)),  # of the scaled terms
        ("total_length", np.float64),
        ("extended", np.int64),  # 1: observations are
        ("pays", np.int64),
    ],
    align=True,
)
"""What does not change."""

SUMS = (
    "steps_all", "steps_av", "steps_hdv", "vehicles", "speed", "speed_av", "speed_hdv", "acceleration_av",
    "acceleration_hdv", "hardest_braking_av", "hardest_braking_hdv", "fuel", "standing", "team_return",
    "paper_return",
)  # fmt: skip
"""What adds up to the metrics: steps with vehicles of a kind, means over these in a step (of `vehicles` their
number), what was paid; but `hardest_braking` is the most of all steps."""

ACCOUNT = np.dtype(
    [
        ("state", np.float32, STATE_SIZE),
        ("scaled", np.float64, len(TERMS)),  # terms in [-1, 1], in the order of TERMS
        ("paper", np.float64, len(TERMS)),  # the paper's terms with their gains
        *((name, np.float64) for name in SUMS),  # of the episode, as the next two
        ("terms", np.float64, len(TERMS)),  # of the reward that is paid
        ("present", np.float64, 4),  # steps that AVs have spent here, by approach
    ],
    align=True,
)
"""What follows for all together, and what has been added up in the episode."""

SCRATCH = np.dtype(
    [
        ("first", np.int64, WAYS),  # the row of the first before the stop line; -1: none
        ("inside", np.int64, MOST_VEHICLES + 1),  # rows of those inside the junction, then -1
        ("soonest", np.float64, NEIGHBOURS),  # s until who comes next on crossing ways arrives
        ("ranked", np.int64, NEIGHBOURS),  # their rows; -1: nobody
    ],
    align=True,
)
"""Room for the kernel to find out who comes next."""


class Traffic(NamedTuple):
    """All vehicles, in rows 0 to V - 1 of arrays that are longer: the fields of TRAFFIC, in its memory.
    Compiled code has its record, whose fields read alike."""

    position: Floats
    """Front along the whole way: the stop line is at ROAD_M."""
    speed: Floats
    before: Floats
    """Speed one step before."""
    fuel: Floats
    """ml/s"""
    offset: Floats
    """Place at which a vehicle entered, m, less the distance it had been driven by then."""
    link: Whole
    slot: Whole
    """-1: driven by SUMO."""
    around: Floats
    """(V, 4): row of the vehicle ahead (-1: none) and its distance, the same of the one behind; valid where
    there is a slot."""

    @classmethod
    def of(cls, memory: NDArray[np.void]) -> "Traffic":
        """In an array (1,) of TRAFFIC."""
        return cls(*(memory[name][0] for name in cls._fields))


TRAFFIC = np.dtype(
    [(name, np.float64, MOST_VEHICLES) for name in ("position", "speed", "before", "fuel", "offset")]
    + [(name, np.int64, MOST_VEHICLES) for name in ("link", "slot")]
    + [("around", np.float64, (MOST_VEHICLES, 4))]
)


class Slots(NamedTuple):
    """What concerns each AV."""

    observations: NDArray[np.float32]
    """(N, D); rows of empty slots are 0."""
    alive: NDArray[np.bool_]
    """(N,)"""
    acting: NDArray[np.bool_]
    """(N,): who was asked for the action that is carried out."""
    rewards: NDArray[np.float32]
    """(N,): since then; a step's are added."""

    @classmethod
    def empty(cls, slots: int, extended: bool) -> "Slots":
        """Room for so many."""
        return cls(
            observations=np.zeros((slots, EXTENDED_SIZE if extended else PAPER_SIZE), np.float32),
            alive=np.zeros(slots, np.bool_),
            acting=np.zeros(slots, np.bool_),
            rewards=np.zeros(slots, np.float32),
        )


class StepEvents(NamedTuple):
    """What the step brought, beside places and speeds."""

    arrived: int = 0
    crashes: int = 0
    """Pairs of vehicles."""
    lane_changes: int = 0
    """Of AVs."""
    outflow_vph: float = 0.0
    """Since the episode's beginning."""
    pending: int = 0
    """Vehicles that wait to enter."""
    passed: float = 0.0
    """Share of the episode."""
