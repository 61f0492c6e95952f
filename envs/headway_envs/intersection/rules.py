"""Controllers for comparison: human drivers, constant actions, first come first served, and a signal."""

from dataclasses import dataclass
from hashlib import blake2b
from typing import TYPE_CHECKING, ClassVar

import numpy as np
from numpy.typing import NDArray

from headway.contracts import BatchedEnv, Observations
from headway_envs.intersection.config import CLEAR_S, GREEN_S, STEP_S
from headway_envs.intersection.env import IntersectionBatchedEnv
from headway_envs.intersection.kernel import MAX_ACCELERATION
from headway_envs.intersection.network import ROAD_M
from headway_envs.intersection.sumo.roster import Roster

if TYPE_CHECKING:
    from headway_envs.intersection.prepared import Prepared

ALL_CHECKS, SAFE_GAP_ONLY = 31, 1
"""SUMO's speed modes: all checks, including right of way; only a safe gap to the leader."""
CRUISE = 15.0
"""Cruising speed of AVs under the rules, m/s."""
BRAKING = 2.0
"""Deceleration for which braking distances are planned, m/s^2."""


def _require_intersection(env: BatchedEnv) -> IntersectionBatchedEnv:
    if not isinstance(env, IntersectionBatchedEnv):
        raise TypeError(f"the intersection's rules need an IntersectionBatchedEnv, not {type(env).__name__}")
    return env


def _constant_actions(observed: Observations, value: float = 0.0) -> NDArray[np.float32]:
    return np.full((*observed.alive.shape, 1), value, np.float32)


@dataclass(frozen=True)
class Humans:
    """SUMO drives all vehicles as humans, including the automated ones."""

    prepared: "Prepared"
    right_of_way: bool
    """True: drivers apply all checks, including right of way. False: only a safe gap to the leader."""

    def act(self, env: BatchedEnv, observed: Observations) -> NDArray[np.float32]:
        """Return zeros (1, N, 1), which the environment ignores."""
        speed_mode = ALL_CHECKS if self.right_of_way else SAFE_GAP_ONLY
        _require_intersection(env).bridge.hand_over(speed_mode)
        return _constant_actions(observed)


@dataclass(frozen=True)
class Constant:
    """Command the same acceleration at every step."""

    prepared: "Prepared"
    share: float
    """Commanded acceleration as a share of the maximum."""

    def act(self, env: BatchedEnv, observed: Observations) -> NDArray[np.float32]:
        """Return accelerations (1, N, 1), m/s^2."""
        return _constant_actions(observed, self.share * MAX_ACCELERATION)


class Reservation:
    """First come, first served (after Dresner and Stone 2008, arXiv:1401.3466).

    A vehicle that comes within `ZONE_M` of the stop line joins a queue, and may enter the junction once all
    vehicles on conflicting paths ahead of it in the queue have passed. Human drivers do not obey the queue:
    they block others while they move, but not while they stand, because then they are waiting themselves."""

    ZONE_M = 100.0
    STOP_M = 3.0
    """Stopping distance before the stop line, m."""
    STANDING = 0.5
    """Speed below which a human driver counts as standing, m/s."""

    def __init__(self, prepared: "Prepared") -> None:
        self._tickets: dict[str, int] = {}
        self._next_ticket = 0

    def act(self, env: BatchedEnv, observed: Observations) -> NDArray[np.float32]:
        """Return accelerations (1, N, 1), m/s^2."""
        native = _require_intersection(env)
        if native.steps_taken == 0:
            self._tickets, self._next_ticket = {}, 0
        bridge = native.bridge
        roster, network = bridge.roster, bridge.network
        traffic, actions = roster.traffic, _constant_actions(observed)
        waiting = self._queue(roster, network.link_length)
        for row, slot, vehicle in roster.automated:
            left, link = ROAD_M - float(traffic.position[row]), int(traffic.link[row])
            target = _free_speed(native, row)
            if 0 < left < self.ZONE_M:
                earlier = waiting[: waiting.index(row)] if vehicle in self._tickets else waiting
                if self._blocked(roster, link, earlier, network.foes):
                    target = min(target, _braking_speed(0.0, left - self.STOP_M))
            actions[0, slot, 0] = _acceleration_to(native, row, target)
        return actions

    def _queue(self, roster: Roster, link_length: NDArray[np.float64]) -> list[int]:
        """Return the rows of the queued vehicles in order of arrival; ties: the nearest first."""
        traffic, count = roster.traffic, len(roster)
        position = traffic.position[:count]
        there = (position > ROAD_M - self.ZONE_M) & (position < ROAD_M + link_length[traffic.link[:count]])
        rows = np.flatnonzero(there)
        for row in sorted(rows.tolist(), key=lambda row: -position[row]):
            if roster.ids[row] not in self._tickets:
                self._tickets[roster.ids[row]] = self._next_ticket
                self._next_ticket += 1
        return sorted(rows.tolist(), key=lambda row: self._tickets[roster.ids[row]])

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
    """Traffic signal that only AVs observe, and thereby impose on the humans behind them.

    Sources: virtual traffic lights (Ferreira et al. 2010, "Self-organized traffic control"); control of mixed
    traffic by a few holding vehicles (Wang et al. 2023, arXiv:2301.05294). North and south have green for
    `GREEN_S`, then, after a clearance of `CLEAR_S`, east and west. At red an AV holds far before the stop
    line, because SUMO's drivers wait for a vehicle that stands closer, as if it were about to enter; an AV
    that is too close to hold drives on. SUMO's checks (`av_speed_mode`) enforce the right of way among
    vehicles with green. With a `share` below 1 the other AVs drive as without a signal, which measures its
    benefit at partial compliance."""

    prepared: "Prepared"
    share: float = 1.0
    """Share of AVs that observe the signal."""

    HOLD_M: ClassVar[float] = 60.0
    """Holding distance before the stop line, m."""
    MARGIN_M: ClassVar[float] = 10.0
    """Maximum overshoot of the holding position, m."""

    def act(self, env: BatchedEnv, observed: Observations) -> NDArray[np.float32]:
        """Return accelerations (1, N, 1), m/s^2."""
        native = _require_intersection(env)
        traffic, actions = native.bridge.roster.traffic, _constant_actions(observed)
        turn, since = divmod(native.steps_taken * STEP_S, GREEN_S + CLEAR_S)
        green = int(turn) % 2 if since < GREEN_S else None
        for row, slot, vehicle in native.bridge.roster.automated:
            speed, to_hold = float(traffic.speed[row]), ROAD_M - self.HOLD_M - float(traffic.position[row])
            target = _free_speed(native, row)
            red = int(traffic.link[row]) // 4 % 2 != green and self._complies(vehicle, native.episode)
            if red and self._can_stop(speed, to_hold):
                target = min(target, _braking_speed(0.0, to_hold))
            actions[0, slot, 0] = _acceleration_to(native, row, target)
            if speed == target == 0.0:
                # Drives the same, but policies that imitate it and add noise do not creep past the position.
                actions[0, slot, 0] = -MAX_ACCELERATION
        return actions

    def _complies(self, vehicle: str, episode: tuple[int, int]) -> bool:
        """Return whether a vehicle observes the signal; drawn per vehicle and episode."""
        draw = blake2b(f"{vehicle} {episode}".encode(), digest_size=4).digest()
        return int.from_bytes(draw) < self.share * 2**32

    def _can_stop(self, speed: float, distance: float) -> bool:
        """Return whether a vehicle can stop within `distance` + `MARGIN_M`, m."""
        return distance > -self.MARGIN_M and speed**2 <= 2 * MAX_ACCELERATION * (distance + self.MARGIN_M)


def _free_speed(env: IntersectionBatchedEnv, row: int) -> float:
    """Return the speed of an AV on an empty road, m/s: the cruising speed, or less before its turn."""
    traffic, network = env.bridge.roster.traffic, env.bridge.network
    left, turn_speed = ROAD_M - float(traffic.position[row]), float(network.link_speed[traffic.link[row]])
    if left > 0:
        return min(CRUISE, _braking_speed(turn_speed, left))
    straight = int(traffic.link[row]) % 4 in (1, 2)
    return max(CRUISE, turn_speed) if straight else CRUISE


def _braking_speed(speed: float, distance: float) -> float:
    """Return the speed from which braking reaches `speed` within `distance`, m/s."""
    return float(np.sqrt(speed**2 + 2 * BRAKING * max(distance, 0.0)))


def _acceleration_to(env: IntersectionBatchedEnv, row: int, speed: float) -> float:
    """Return the acceleration that brings the speed closest to `speed` by the next action, m/s^2."""
    change = speed - float(env.bridge.roster.traffic.speed[row])
    return float(np.clip(change / (STEP_S * env.config.action_repeat), -MAX_ACCELERATION, MAX_ACCELERATION))
