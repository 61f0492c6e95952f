"""Controllers to compare with: human drivers, constant actions, and first come, first served."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from headway.contracts import BatchedEnv, Observed
from headway_envs.intersection.config import STEP_S
from headway_envs.intersection.env import IntersectionBatchedEnv
from headway_envs.intersection.kernel import STRONGEST
from headway_envs.intersection.network import ROAD_M
from headway_envs.intersection.roster import Roster

ALL_CHECKS, SAFE_GAP_ONLY = 31, 1
"""SUMO's speed modes: every check, right of way among them; no more than a safe gap to the leader."""


def _of(env: BatchedEnv) -> IntersectionBatchedEnv:
    if not isinstance(env, IntersectionBatchedEnv):
        raise TypeError(f"the intersection's rules need an IntersectionBatchedEnv, not {type(env).__name__}")
    return env


def _actions(observed: Observed, value: float = 0.0) -> NDArray[np.float32]:
    return np.full((*observed.alive.shape, 1), value, np.float32)


@dataclass(frozen=True)
class Humans:
    """SUMO drives all vehicles as humans, those that would be automated, too."""

    speed_mode: int

    def act(self, env: BatchedEnv, observed: Observed) -> NDArray[np.float32]:
        """(1, N, 1): zeros, which nobody heeds."""
        _of(env).hand_over(self.speed_mode)
        return _actions(observed)


@dataclass(frozen=True)
class Constant:
    """The same acceleration always, m/s^2."""

    acceleration: float

    def act(self, env: BatchedEnv, observed: Observed) -> NDArray[np.float32]:
        """(1, N, 1)"""
        return _actions(observed, self.acceleration)


class Reservation:
    """First come, first served (after Dresner and Stone 2008, arXiv:1401.3466): who comes within `ZONE_M` of
    the stop line asks for its way through the junction, and has it while no vehicle whose way crosses and who
    asked before has not passed. Human drivers cannot be told: they hold their place in the order, unless they
    stand, since then they are the ones who wait."""

    ZONE_M = 100.0
    BRAKING = 2.0
    """With which an AV without reservation comes to its stop, m/s^2."""
    STOP_M = 3.0
    """From the stop line."""
    CRUISE = 15.0
    """m/s"""
    STANDING = 0.5
    """m/s"""

    def __init__(self) -> None:
        self._asked: dict[str, int] = {}
        self._next = 0

    def act(self, env: BatchedEnv, observed: Observed) -> NDArray[np.float32]:
        """(1, N, 1)"""
        native = _of(env)
        if native.steps_taken == 0:
            self._asked, self._next = {}, 0
        street = native.street
        roster, network = street.roster, street.network
        traffic, actions = roster.traffic, _actions(observed)
        waiting = self._in_order(roster, network.link_length)
        for row, slot, vehicle in roster.automated:
            speed, left = float(traffic.speed[row]), ROAD_M - float(traffic.position[row])
            link = int(traffic.link[row])
            wished = self.CRUISE
            if 0 < left < self.ZONE_M:
                wished = min(self.CRUISE, self._approach(left, float(network.link_speed[link])))
                earlier = waiting[: waiting.index(row)] if vehicle in self._asked else waiting
                if self._blocked(roster, link, earlier, network.foes):
                    wished = min(wished, self._approach(left - self.STOP_M, 0.0))
            elif left <= 0 and link % 4 in (1, 2):
                wished = max(self.CRUISE, float(network.link_speed[link]))
            actions[0, slot, 0] = np.clip((wished - speed) / STEP_S, -STRONGEST, STRONGEST)
        return actions

    def _in_order(self, roster: Roster, link_length: NDArray[np.float64]) -> list[int]:
        """Rows of those who have asked and not passed, in the order in which they asked; who comes anew at
        the same moment, the nearest first."""
        traffic, count = roster.traffic, len(roster)
        position = traffic.position[:count]
        there = (position > ROAD_M - self.ZONE_M) & (position < ROAD_M + link_length[traffic.link[:count]])
        rows = np.flatnonzero(there)
        for row in sorted(rows.tolist(), key=lambda row: -position[row]):
            if roster.ids[row] not in self._asked:
                self._asked[roster.ids[row]] = self._next
                self._next += 1
        return sorted(rows.tolist(), key=lambda row: self._asked[roster.ids[row]])

    def _blocked(self, roster: Roster, link: int, earlier: list[int], foes: NDArray[np.bool_]) -> bool:
        traffic = roster.traffic
        for row in earlier:
            if not foes[link, traffic.link[row]]:
                continue
            human = traffic.slot[row] < 0
            if not (human and traffic.speed[row] < self.STANDING and traffic.position[row] < ROAD_M):
                return True
        return False

    def _approach(self, distance: float, speed: float) -> float:
        """The speed from which `speed` is reached within a distance."""
        return float(np.sqrt(speed**2 + 2 * self.BRAKING * max(distance, 0.0)))
