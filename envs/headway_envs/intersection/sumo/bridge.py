"""The vehicles of one simulation: commanded, advanced by a step, and read."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from math import inf
from struct import pack_into
from typing import Any

import numpy as np
from numpy.typing import NDArray

from headway_envs.intersection.config import STEP_S, IntersectionConfig
from headway_envs.intersection.demand import AV, HDV, MIN_GAP_M
from headway_envs.intersection.human_drivers import next_speeds
from headway_envs.intersection.kernel import wish
from headway_envs.intersection.layout import (
    CROSSING,
    MOST_VEHICLES,
    PAY_OWN,
    PAY_PAPER,
    PAY_TEAM,
    Floats,
)
from headway_envs.intersection.network import APPROACHES, LINKS, ROAD_M, Network
from headway_envs.intersection.sumo.roster import Roster
from headway_envs.intersection.sumo.simulation import Simulation

NO_LANE_CHANGES = 512
_SUMOS_OWN = -1.0
"""As a speed: SUMO drives."""
_AHEAD_M = 200.0
_NOBODY = ("", 0.0)


@dataclass(slots=True)
class Changes:
    """What a step brought."""

    entered: int = 0
    arrived: int = 0
    """Left at the end of their way."""
    crashes: int = 0
    """Pairs."""
    avs: int = 0
    """Of those that entered."""
    without_slot: int = 0
    pending: int = 0
    lane_changes: int = 0
    left: tuple[int, ...] = ()
    """Slots of AVs that arrived."""
    crashed: tuple[int, ...] = ()
    """Slots of AVs that crashed."""
    travels: tuple[tuple[int, float], ...] = ()
    """(approach, s) of AVs that arrived."""
    places: tuple[tuple[float, float], ...] = ()
    """Where vehicles crashed, (x, y) in m, for pictures."""


def _crossing(config: IntersectionConfig, network: Network) -> NDArray[np.void]:
    """(1,) CROSSING"""
    reward, crossing = config.reward, np.zeros(1, CROSSING)
    crossing["link_length"], crossing["total_length"] = network.link_length, network.total_length
    crossing["foes"], crossing["yields"] = network.foes, network.yields
    crossing["weights"], crossing["extended"] = reward.weights, config.observation == "extended"
    scaled = PAY_OWN if reward.scope == "own" else PAY_TEAM
    crossing["pays"] = PAY_PAPER if reward.kind == "paper" else scaled
    return crossing


class SumoBridge:
    """Keeps a roster in step with SUMO. Vehicles are read and commanded in the order in which they came.

    After `advance` speeds and places are still those before: the kernel has yet to take the `answers` in.
    """

    def __init__(self, config: IntersectionConfig, network: Network, simulation: Simulation) -> None:
        self.config, self.network, self.simulation = config, network, simulation
        self.roster = Roster(config.slots)
        self.crossing = _crossing(config, network)
        self.answers: Floats = np.zeros(3 * MOST_VEHICLES + 4 * config.slots)
        """SUMO's of the last step, as `kernel.take_in` reads them."""
        self._vehicle: Any = simulation.sumo.vehicle
        self._world: Any = simulation.sumo.simulation
        self._handed_over: int | None = None
        self._waiting = 0
        self._draw = np.random.default_rng(0)
        self._wished = np.zeros(config.slots)

    def begin(self, seed: int, draw: np.random.Generator) -> None:
        """An empty crossing; `draw` is for the noise of human drivers."""
        self.simulation.begin(seed)
        self.roster.clear()
        self._draw, self._waiting = draw, 0
        self._handed_over = None

    def close(self) -> None:
        """Let go of the simulation."""
        self.simulation.close()

    def hand_over(self, speed_mode: int) -> None:
        """From now on all vehicles are driven as humans, with this speed mode."""
        if self._handed_over == speed_mode:
            return
        self._handed_over = speed_mode
        for vehicle in self.roster.ids:
            self._instruct(vehicle, automated=vehicle.startswith(AV))
            self._vehicle.setSpeed(vehicle, _SUMOS_OWN)

    def command(self, accelerations: NDArray[np.float32], acting: NDArray[np.bool_]) -> None:
        """Speeds of the next step: AVs' from accelerations (N,), cut at 3 m/s^2, of those `acting` (N,),
        noisy humans' from their model."""
        roster, wished = self.roster, self._wished
        if self._handed_over is None and roster.automated:
            wish(accelerations, acting, roster.memory, len(roster), wished)
            set_speed, targets = self._vehicle.setSpeed, wished[: len(roster.automated)].tolist()
            for vehicle, target in zip(roster.automated_ids, targets, strict=True):
                set_speed(vehicle, target)
        if self.config.human_noise > 0:
            self._drive_humans()

    def advance(self, step: int, kept: Collection[int] = ()) -> Changes:
        """One step of SUMO, the `step`-th, and its `answers` about all vehicles for the kernel to take in.
        Slots in `kept` stay empty."""
        world, changes = self._world, Changes()
        world.step()
        crashed: frozenset[str] = frozenset()
        if crashes := world.getCollisions():
            pairs = {frozenset((crash.collider, crash.victim)) for crash in crashes}
            changes.crashes, crashed = len(pairs), frozenset().union(*pairs)
        arrived = world.getArrivedIDList()
        if arrived or crashed:
            self._take_away(arrived, crashed, step, changes)
        for vehicle in world.getDepartedIDList():
            self._let_in(vehicle, (*kept, *changes.left, *changes.crashed), step, changes)
        self._waiting += world.getLoadedNumber() - changes.entered
        changes.pending = self._waiting
        self._read(changes)
        return changes

    def _take_away(
        self, arrived: Sequence[str], crashed: frozenset[str], step: int, changes: Changes
    ) -> None:
        """Vehicles that left the road. Those that crashed are in SUMO's list of arrivals, too."""
        roster = self.roster
        gone = [vehicle for vehicle in arrived if vehicle not in crashed]
        changes.arrived = len(gone)
        for vehicle in (*gone, *sorted(crashed)):
            row = roster.row.get(vehicle)
            if row is None:
                continue
            slot, link = int(roster.traffic.slot[row]), int(roster.traffic.link[row])
            if vehicle in crashed:
                changes.places += (self.place(row),)
            if slot >= 0 and vehicle in crashed:
                changes.crashed += (slot,)
            elif slot >= 0:
                changes.left += (slot,)
                changes.travels += ((link // 4, (step - int(roster.entered[row])) * STEP_S),)
            roster.remove(vehicle)

    def _let_in(self, vehicle: str, freed: Sequence[int], step: int, changes: Changes) -> None:
        """A vehicle that has just entered. Slots that have just been freed stay free: their last observations
        are still to be given."""
        ask, automated = self._vehicle, vehicle.startswith(AV)
        approach, turn = ask.getRouteID(vehicle).split("_")
        link = 4 * APPROACHES.index(approach) + LINKS.index((turn, ask.getLaneIndex(vehicle)))
        slot = self.roster.free_slot(freed) if automated else -1
        changes.entered += 1
        changes.avs += automated
        changes.without_slot += automated and slot < 0
        place = ask.getLanePosition(vehicle), ask.getDistance(vehicle)
        self.roster.add(vehicle, link, slot, place, ask.getSpeed(vehicle), step)
        self._instruct(vehicle, automated and slot >= 0)

    def _instruct(self, vehicle: str, automated: bool) -> None:
        """Tell SUMO what it may do with a vehicle."""
        if self._handed_over is not None:
            self._vehicle.setSpeedMode(vehicle, self._handed_over)
            self._vehicle.setLaneChangeMode(vehicle, 1621)
            if vehicle.startswith(AV):
                self._vehicle.setType(vehicle, HDV)
        elif automated:
            self._vehicle.setSpeedMode(vehicle, self.config.av_speed_mode)
            self._vehicle.setLaneChangeMode(vehicle, self.config.av_lane_change_mode)
        else:
            self._vehicle.setSpeedMode(vehicle, self.config.hdv_speed_mode)

    def _read(self, changes: Changes) -> None:
        vehicle, ids = self._vehicle, self.roster.ids
        pack_into(
            f"{3 * len(ids) + 4 * len(self.roster.automated)}d",
            self.answers.data,
            0,
            *map(vehicle.getSpeed, ids),
            *map(vehicle.getDistance, ids),
            *map(vehicle.getFuelConsumption, ids),
            *self._neighbours(),
        )
        if self.config.av_lane_change_mode != NO_LANE_CHANGES and self._handed_over is None:
            changes.lane_changes = self._count_lane_changes(self.answers[len(ids) :])

    def _neighbours(self) -> list[float]:
        """Of each AV, the row of its leader and the gap, the row of its follower and the gap."""
        row_of = self.roster.row.get
        get_leader, get_follower = self._vehicle.getLeader, self._vehicle.getFollower
        around: list[float] = []
        for each in self.roster.automated_ids:
            leader, lead_gap = get_leader(each, _AHEAD_M) or _NOBODY
            follower, follow_gap = get_follower(each, _AHEAD_M)
            around += (row_of(leader, -1), lead_gap, row_of(follower, -1), follow_gap)
        return around

    def _count_lane_changes(self, driven: Floats) -> int:
        """AVs that are on another lane of the same road than a step before, from how far all (V,) have been
        driven, m."""
        roster, changes = self.roster, 0
        for row, _, vehicle in roster.automated:
            position, link = driven[row] + roster.traffic.offset[row], roster.traffic.link[row]
            beyond = position >= ROAD_M + self.network.link_length[link]
            lane = self._vehicle.getLaneIndex(vehicle) + 2 * beyond if beyond or position < ROAD_M else -1
            known = int(roster.lane[row])
            changes += min(lane, known) >= 0 and lane // 2 == known // 2 and lane != known
            roster.lane[row] = lane
        return changes

    def _drive_humans(self) -> None:
        """Our model on the roads; inside the junction SUMO's own drives."""
        traffic, count, ids = self.roster.traffic, len(self.roster), self.roster.ids
        human = np.ones(count, np.bool_) if self._handed_over is not None else traffic.slot[:count] < 0
        position = traffic.position[:count]
        inside = (position >= ROAD_M) & (position < ROAD_M + self.network.link_length[traffic.link[:count]])
        rows = (human & ~inside).nonzero()[0]
        driven = [ids[row] for row in rows.tolist()]
        set_speed, get_leader, row_of = self._vehicle.setSpeed, self._vehicle.getLeader, self.roster.row.get
        # Lists: a single number of an array takes several times as long.
        speeds, lead_speed, gap = traffic.speed[:count].tolist(), [0.0] * len(rows), [inf] * len(rows)
        for place, vehicle in enumerate(driven):
            ahead = get_leader(vehicle, _AHEAD_M)
            if ahead is not None:
                leader = row_of(ahead[0])
                lead_speed[place] = 0.0 if leader is None else speeds[leader]
                gap[place] = ahead[1] + MIN_GAP_M
        wished = next_speeds(
            traffic.speed[rows], np.array(lead_speed), np.array(gap), self.config.human_noise, self._draw
        )
        for vehicle, target in zip(driven, wished.tolist(), strict=True):
            set_speed(vehicle, target)
        for row in (human & inside).nonzero()[0].tolist():
            set_speed(ids[row], _SUMOS_OWN)

    def place(self, row: int) -> tuple[float, float]:
        """Where the front of the vehicle in a row was when it was read last: (x, y) in m, centre (0, 0)."""
        traffic = self.roster.traffic
        return self.network.place(int(traffic.link[row]), float(traffic.position[row]))
