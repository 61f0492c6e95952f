"""Controllers to compare with: human drivers, constant actions, first come, first served, and a signal."""

from dataclasses import dataclass
from hashlib import blake2b
from typing import TYPE_CHECKING, ClassVar

import numpy as np
from numpy.typing import NDArray

from headway.contracts import BatchedEnv, Observations
from headway_envs.intersection.config import STEP_S
from headway_envs.intersection.env import IntersectionBatchedEnv
from headway_envs.intersection.kernel import STRONGEST
from headway_envs.intersection.network import ROAD_M
from headway_envs.intersection.sumo.roster import Roster

if TYPE_CHECKING:
    from headway_envs.intersection.prepared import Prepared

ALL_CHECKS, SAFE_GAP_ONLY = 31, 1
"""SUMO's speed modes: every check, right of way among them; no more than a safe gap to the leader."""
CRUISE = 15.0
"""Of AVs that keep a rule, m/s."""
BRAKING = 2.0
"""With which they begin to slow down, m/s^2."""


def _of(env: BatchedEnv) -> IntersectionBatchedEnv:
    if not isinstance(env, IntersectionBatchedEnv):
        raise TypeError(f"the intersection's rules need an IntersectionBatchedEnv, not {type(env).__name__}")
    return env


def _actions(observed: Observations, value: float = 0.0) -> NDArray[np.float32]:
    return np.full((*observed.alive.shape, 1), value, np.float32)


@dataclass(frozen=True)
class Humans:
    """SUMO drives all vehicles as humans, those that would be automated, too."""

    prepared: "Prepared"
    right_of_way: bool
    """Whether drivers check everything, right of way included, or keep a safe gap to the leader alone."""

    def act(self, env: BatchedEnv, observed: Observations) -> NDArray[np.float32]:
        """(1, N, 1): zeros, which nobody heeds."""
        _of(env).hand_over(ALL_CHECKS if self.right_of_way else SAFE_GAP_ONLY)
        return _actions(observed)


@dataclass(frozen=True)
class Constant:
    """Ask for the same acceleration at every step."""

    prepared: "Prepared"
    share: float
    """Share of the strongest acceleration that is asked for."""

    def act(self, env: BatchedEnv, observed: Observations) -> NDArray[np.float32]:
        """(1, N, 1)"""
        return _actions(observed, self.share * STRONGEST)


class Reservation:
    """First come, first served (after Dresner and Stone 2008, arXiv:1401.3466): who comes within `ZONE_M` of
    the stop line asks for its way through the junction, and has it while no vehicle whose way crosses and who
    asked before has not passed. Human drivers cannot be told: they hold their place in the order, unless they
    stand, since then they are the ones who wait."""

    ZONE_M = 100.0
    STOP_M = 3.0
    """From the stop line."""
    STANDING = 0.5
    """m/s"""

    def __init__(self, prepared: "Prepared") -> None:
        self._asked: dict[str, int] = {}
        self._next = 0

    def act(self, env: BatchedEnv, observed: Observations) -> NDArray[np.float32]:
        """(1, N, 1)"""
        native = _of(env)
        if native.steps_taken == 0:
            self._asked, self._next = {}, 0
        street = native.street
        roster, network = street.roster, street.network
        traffic, actions = roster.traffic, _actions(observed)
        waiting = self._in_order(roster, network.link_length)
        for row, slot, vehicle in roster.automated:
            left, link = ROAD_M - float(traffic.position[row]), int(traffic.link[row])
            wished = _unhindered(native, row)
            if 0 < left < self.ZONE_M:
                earlier = waiting[: waiting.index(row)] if vehicle in self._asked else waiting
                if self._blocked(roster, link, earlier, network.foes):
                    wished = min(wished, _slowing_to(0.0, left - self.STOP_M))
            actions[0, slot, 0] = _towards(native, row, wished)
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


@dataclass(frozen=True)
class VirtualSignal:
    """A signal that AVs alone know and keep, and by that impose on the humans behind them (virtual traffic
    lights: Ferreira et al. 2010, "Self-organized traffic control"; that a few vehicles that hold can part
    mixed traffic: Wang et al. 2023, arXiv:2301.05294). Those from north and south have `GREEN_S`, then those
    from east and west. Who comes to red holds far before the stop line: of a vehicle that stands nearer,
    SUMO's drivers take it that it is about to enter, and wait. Who is nearer already drives on. Among those
    with green, SUMO's checks (`av_speed_mode`) say who goes first. Below a `share` of 1 the other AVs drive
    as if there were no signal, which tells what it gains as long as not all keep it."""

    prepared: "Prepared"
    share: float = 1.0
    """Of AVs, those that keep the signal."""

    GREEN_S: ClassVar[float] = 30.0
    CLEAR_S: ClassVar[float] = 4.0
    """Between two greens, for those too near to hold."""
    HOLD_M: ClassVar[float] = 60.0
    """From the stop line."""
    MARGIN_M: ClassVar[float] = 10.0
    """By which one may come to a stop beyond it."""

    def act(self, env: BatchedEnv, observed: Observations) -> NDArray[np.float32]:
        """(1, N, 1)"""
        native = _of(env)
        traffic, actions = native.street.roster.traffic, _actions(observed)
        turn, since = divmod(native.steps_taken * STEP_S, self.GREEN_S + self.CLEAR_S)
        green = int(turn) % 2 if since < self.GREEN_S else None
        for row, slot, vehicle in native.street.roster.automated:
            speed, to_hold = float(traffic.speed[row]), ROAD_M - self.HOLD_M - float(traffic.position[row])
            wished = _unhindered(native, row)
            red = int(traffic.link[row]) // 4 % 2 != green and self._keeps(vehicle, native.episode)
            if red and self._can_hold(speed, to_hold):
                wished = min(wished, _slowing_to(0.0, to_hold))
            actions[0, slot, 0] = _towards(native, row, wished)
        return actions

    def _keeps(self, vehicle: str, episode: tuple[int, int]) -> bool:
        """Whether a vehicle is among the share that does, drawn for each in each episode."""
        draw = blake2b(f"{vehicle} {episode}".encode(), digest_size=4).digest()
        return int.from_bytes(draw) < self.share * 2**32

    def _can_hold(self, speed: float, distance: float) -> bool:
        """Whether a vehicle comes to a stop within a distance, m, and `MARGIN_M`."""
        return distance > -self.MARGIN_M and speed**2 <= 2 * STRONGEST * (distance + self.MARGIN_M)


def _unhindered(env: IntersectionBatchedEnv, row: int) -> float:
    """The speed at which an AV would drive if it were alone, m/s: it brakes for its turn."""
    traffic, network = env.street.roster.traffic, env.street.network
    left, turn_speed = ROAD_M - float(traffic.position[row]), float(network.link_speed[traffic.link[row]])
    if left > 0:
        return min(CRUISE, _slowing_to(turn_speed, left))
    straight = int(traffic.link[row]) % 4 in (1, 2)
    return max(CRUISE, turn_speed) if straight else CRUISE


def _slowing_to(speed: float, distance: float) -> float:
    """The speed from which `speed` is reached within a distance."""
    return float(np.sqrt(speed**2 + 2 * BRAKING * max(distance, 0.0)))


def _towards(env: IntersectionBatchedEnv, row: int, speed: float) -> float:
    """The acceleration that comes nearest to a speed until actions are asked for again."""
    change = speed - float(env.street.roster.traffic.speed[row])
    return float(np.clip(change / (STEP_S * env.config.action_repeat), -STRONGEST, STRONGEST))
