"""Bridge to a SUMO simulation: commands its vehicles, runs its steps and reads the state of its vehicles."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from math import inf
from struct import pack_into
from typing import Any

import numpy as np
from numpy.typing import NDArray

from headway_envs.intersection.config import STEP_S, IntersectionConfig
from headway_envs.intersection.demand import AV, HDV, MIN_GAP_M
from headway_envs.intersection.kernel import target_speeds
from headway_envs.intersection.layout import (
    CROSSING,
    MAX_VEHICLES,
    REWARD_OWN,
    REWARD_PAPER,
    REWARD_TEAM,
    Floats,
)
from headway_envs.intersection.network import APPROACHES, LINKS, ROAD_M, Network
from headway_envs.intersection.sumo.human_drivers import next_speeds
from headway_envs.intersection.sumo.roster import Roster
from headway_envs.sumo_simulation import SUMO_CONTROL, Simulation

NO_LANE_CHANGES = 512
_AHEAD_M = 200.0
_NO_VEHICLE = ("", 0.0)


@dataclass(slots=True)
class Changes:
    """Vehicles that entered, left or crashed in one step."""

    entered: int = 0
    arrived: int = 0
    """Vehicles that left at their exit."""
    crashes: int = 0
    """Pairs of vehicles."""
    avs: int = 0
    """AVs among the entered vehicles."""
    without_slot: int = 0
    """AVs among the entered vehicles for which no slot was free."""
    pending: int = 0
    """Vehicles waiting to enter."""
    lane_changes: int = 0
    left: tuple[int, ...] = ()
    """Slots of AVs that arrived."""
    crashed: tuple[int, ...] = ()
    """Slots of AVs that crashed."""
    travels: tuple[tuple[int, float], ...] = ()
    """Approach and travel time, s, of each AV that arrived."""
    places: tuple[tuple[float, float], ...] = ()
    """Positions of crashes for pictures, (x, y) in m from the centre."""


def _crossing(config: IntersectionConfig, network: Network) -> NDArray[np.void]:
    """Return the constants of the kernel, (1,) of CROSSING."""
    reward, crossing = config.reward, np.zeros(1, CROSSING)
    crossing["link_length"], crossing["total_length"] = network.link_length, network.total_length
    crossing["foes"], crossing["yields"] = network.foes, network.yields
    crossing["weights"], crossing["extended"] = reward.weights, config.observation == "extended"
    scaled = REWARD_OWN if reward.scope == "own" else REWARD_TEAM
    crossing["reward_kind"] = REWARD_PAPER if reward.kind == "paper" else scaled
    return crossing


class SumoBridge:
    """Keeps a roster synchronised with SUMO. Vehicles are read and commanded in order of entry.

    `advance` leaves speeds and positions of the roster unchanged: the kernel updates them from `readings`.
    """

    def __init__(self, config: IntersectionConfig, network: Network, simulation: Simulation) -> None:
        self.config, self.network, self.simulation = config, network, simulation
        self.roster = Roster(config.slots)
        self.crossing = _crossing(config, network)
        self.readings: Floats = np.zeros(3 * MAX_VEHICLES + 4 * config.slots)
        """SUMO's values after the last step, in the layout of `kernel.process_step`."""
        self._vehicle: Any = simulation.sumo.vehicle
        self._world: Any = simulation.sumo.simulation
        self._handed_over: int | None = None
        self._pending = 0
        self._draw = np.random.default_rng(0)
        self._targets = np.zeros(config.slots)

    def begin(self, seed: int, routes: str, draw: np.random.Generator) -> None:
        """Start an episode on an empty road; `routes`: content of a SUMO route file; `draw` supplies the
        noise of human drivers."""
        self.simulation.begin(seed, routes)
        self.roster.clear()
        self._draw, self._pending = draw, 0
        self._handed_over = None

    def hand_over(self, speed_mode: int) -> None:
        """Let SUMO drive all vehicles as humans with the given speed mode, ignoring actions, until the
        episode ends."""
        if self._handed_over == speed_mode:
            return
        self._handed_over = speed_mode
        for vehicle in self.roster.ids:
            self._set_modes(vehicle, automated=vehicle.startswith(AV))
            self._vehicle.setSpeed(vehicle, SUMO_CONTROL)

    def command(self, accelerations: NDArray[np.float32], acting: NDArray[np.bool_]) -> None:
        """Command the speeds of the next step.

        AVs follow accelerations (N,), clipped to 3 m/s^2, where `acting` (N,); humans with noise follow
        their model."""
        roster, speeds = self.roster, self._targets
        if self._handed_over is None and roster.automated:
            target_speeds(accelerations, acting, roster.records, len(roster), speeds)
            set_speed, targets = self._vehicle.setSpeed, speeds[: len(roster.automated)].tolist()
            for vehicle, target in zip(roster.automated_ids, targets, strict=True):
                set_speed(vehicle, target)
        if self.config.human_noise > 0:
            self._drive_humans()

    def advance(self, step: int, kept: Collection[int] = ()) -> Changes:
        """Run step number `step` of SUMO and read all vehicles into `readings`.

        Slots in `kept` stay empty.
        """
        world, changes = self._world, Changes()
        world.step()
        crashed: frozenset[str] = frozenset()
        if crashes := world.getCollisions():
            pairs = {frozenset((crash.collider, crash.victim)) for crash in crashes}
            changes.crashes, crashed = len(pairs), frozenset().union(*pairs)
        arrived = world.getArrivedIDList()
        if arrived or crashed:
            self._remove_vehicles(arrived, crashed, step, changes)
        for vehicle in world.getDepartedIDList():
            self._add_vehicle(vehicle, (*kept, *changes.left, *changes.crashed), step, changes)
        self._pending += world.getLoadedNumber() - changes.entered
        changes.pending = self._pending
        self._read(changes)
        return changes

    def _remove_vehicles(
        self, arrived: Sequence[str], crashed: frozenset[str], step: int, changes: Changes
    ) -> None:
        """Remove arrived and crashed vehicles. SUMO lists crashed ones as arrived, too."""
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

    def _add_vehicle(self, vehicle: str, freed: Sequence[int], step: int, changes: Changes) -> None:
        """Add a vehicle that has just entered.

        Slots in `freed` stay empty in this step, because the last observations of their vehicles are still to
        be returned.
        """
        ask, automated = self._vehicle, vehicle.startswith(AV)
        approach, turn = ask.getRouteID(vehicle).split("_")
        link = 4 * APPROACHES.index(approach) + LINKS.index((turn, ask.getLaneIndex(vehicle)))
        slot = self.roster.free_slot(freed) if automated else -1
        changes.entered += 1
        changes.avs += automated
        changes.without_slot += automated and slot < 0
        place = ask.getLanePosition(vehicle), ask.getDistance(vehicle)
        self.roster.add(vehicle, link, slot, place, ask.getSpeed(vehicle), step)
        self._set_modes(vehicle, automated and slot >= 0)

    def _set_modes(self, vehicle: str, automated: bool) -> None:
        """Set SUMO's speed and lane-change modes of a vehicle."""
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
        """Read all vehicles into `readings`, and count lane changes if there can be any."""
        vehicle, ids = self._vehicle, self.roster.ids
        pack_into(
            f"{3 * len(ids) + 4 * len(self.roster.automated)}d",
            self.readings.data,
            0,
            *map(vehicle.getSpeed, ids),
            *map(vehicle.getDistance, ids),
            *map(vehicle.getFuelConsumption, ids),
            *self._neighbours(),
        )
        if self.config.av_lane_change_mode != NO_LANE_CHANGES and self._handed_over is None:
            changes.lane_changes = self._count_lane_changes(self.readings[len(ids) :])

    def _neighbours(self) -> list[float]:
        """Return for each AV the row of its leader, the gap, the row of its follower and the gap (row -1:
        none)."""
        row_of = self.roster.row.get
        get_leader, get_follower = self._vehicle.getLeader, self._vehicle.getFollower
        around: list[float] = []
        for each in self.roster.automated_ids:
            leader, lead_gap = get_leader(each, _AHEAD_M) or _NO_VEHICLE
            follower, follow_gap = get_follower(each, _AHEAD_M)
            around += (row_of(leader, -1), lead_gap, row_of(follower, -1), follow_gap)
        return around

    def _count_lane_changes(self, driven: Floats) -> int:
        """Return the number of AVs that changed to another lane of the same road in the last step.

        `driven` (V,): distances driven by all vehicles, m.
        """
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
        """Command human drivers by the noisy model on the roads; inside the junction SUMO drives them."""
        traffic, count, ids = self.roster.traffic, len(self.roster), self.roster.ids
        human = np.ones(count, np.bool_) if self._handed_over is not None else traffic.slot[:count] < 0
        position = traffic.position[:count]
        inside = (position >= ROAD_M) & (position < ROAD_M + self.network.link_length[traffic.link[:count]])
        rows = (human & ~inside).nonzero()[0]
        driven = [ids[row] for row in rows.tolist()]
        set_speed, get_leader, row_of = self._vehicle.setSpeed, self._vehicle.getLeader, self.roster.row.get
        # Lists, because reading single elements of an array is several times slower.
        speeds, lead_speed, gap = traffic.speed[:count].tolist(), [0.0] * len(rows), [inf] * len(rows)
        for place, vehicle in enumerate(driven):
            ahead = get_leader(vehicle, _AHEAD_M)
            if ahead is not None:
                leader = row_of(ahead[0])
                lead_speed[place] = 0.0 if leader is None else speeds[leader]
                gap[place] = ahead[1] + MIN_GAP_M
        targets = next_speeds(
            traffic.speed[rows], np.array(lead_speed), np.array(gap), self.config.human_noise, self._draw
        )
        for vehicle, target in zip(driven, targets.tolist(), strict=True):
            set_speed(vehicle, target)
        for row in (human & inside).nonzero()[0].tolist():
            set_speed(ids[row], SUMO_CONTROL)

    def place(self, row: int) -> tuple[float, float]:
        """Return the last known position of the front of the vehicle in roster row `row`.

        It is (x, y) in m from the centre.
        """
        traffic = self.roster.traffic
        return self.network.place(int(traffic.link[row]), float(traffic.position[row]))
