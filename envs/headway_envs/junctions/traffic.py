"""Vehicles of a SUMO simulation: who enters, leaves and crashes, where they are, and commands to them."""

import heapq
from collections import Counter
from dataclasses import dataclass
from math import ceil
from typing import Any

import numpy as np
from numpy.typing import NDArray

from headway_envs.junctions.config import JunctionsConfig
from headway_envs.junctions.network import NO_APPROACH, Network
from headway_envs.sumo_simulation import SUMO_CONTROL, Simulation

ACCELERATIONS = (-3.5, 0.0, 1.5)
"""Acceleration of each action, m/s^2."""
CHANGE_LANES = 1621
"""SUMO's lane-change mode with the changes that routes need."""


@dataclass
class Vehicle:
    """A vehicle on the road."""

    slot: int
    """Slot of an AV; -1: driven by SUMO."""
    approach: int = NO_APPROACH
    """Approach that it drives on or reached last; NO_APPROACH: none."""
    distance: float = 0.0
    """Distance to the end of the approach, m; below 0 past the last one."""
    speed: float = 0.0


@dataclass(slots=True)
class Changes:
    """Events of one step."""

    entered: int = 0
    arrived: int = 0
    """Vehicles that left at the end of their route."""
    collided: int = 0
    """Vehicles that collided and were removed."""
    without_slot: int = 0
    """AVs among the entered vehicles for which no slot was free."""
    waiting: int = 0
    """Vehicles waiting to enter."""
    left: tuple[int, ...] = ()
    """Slots of AVs that left at the end of their route."""
    crashed: tuple[int, ...] = ()
    """Slots of AVs that collided."""


class Traffic:
    """All vehicles of a simulation with V vehicles, in order of entry."""

    def __init__(self, config: JunctionsConfig, network: Network, simulation: Simulation) -> None:
        self.config, self.network, self.simulation = config, network, simulation
        self.vehicles: dict[str, Vehicle] = {}
        self.braking: list[tuple[bool, float]] = []
        """Whether each vehicle has a slot, and its deceleration in the last step, m/s^2."""
        self._ask: Any = simulation.sumo.vehicle
        self._world: Any = simulation.sumo.simulation
        self._free: list[int] = []
        self._entered: Counter[str] = Counter()
        self._handed_over: int | None = None

    def begin(self, seed: int, routes: str) -> None:
        """Start an episode on empty roads, with traffic lights off; `routes`: content of a SUMO route
        file."""
        self.simulation.begin(seed, routes)
        self.vehicles, self.braking = {}, []
        self._free = list(range(self.config.slots))
        self._entered.clear()
        self._handed_over = None
        for name, signal in self.network.signals.items():
            self.set_signal(name, signal.off)

    def hand_over(self, speed_mode: int) -> None:
        """Let SUMO drive all vehicles with the given speed mode, ignoring actions, until the episode ends."""
        if self._handed_over == speed_mode:
            return
        self._handed_over = speed_mode
        for name in self.vehicles:
            self._ask.setSpeedMode(name, speed_mode)
            self._ask.setLaneChangeMode(name, CHANGE_LANES)
            self._ask.setSpeed(name, SUMO_CONTROL)

    def set_signal(self, name: str, state: str) -> None:
        """Set the state of a traffic light."""
        self.simulation.sumo.trafficlight.setRedYellowGreenState(name, state)

    def command(self, actions: NDArray[np.int64], acting: NDArray[np.bool_]) -> None:
        """Command the speeds of the next step by actions (N,) of the AVs `acting` (N,)."""
        if self._handed_over is not None:
            return
        slow_down, step_s = self._ask.slowDown, self.config.step_s
        changes, controlled = actions.tolist(), acting.tolist()
        for name, vehicle in self.vehicles.items():
            if vehicle.slot >= 0 and controlled[vehicle.slot]:
                # Named for slowing down, it also speeds up, and keeps the lane's limit.
                change = ACCELERATIONS[changes[vehicle.slot]] * step_s
                slow_down(name, max(0.0, vehicle.speed + change), 0)

    def advance(self) -> Changes:
        """Run one step of SUMO and read all vehicles."""
        world, changes = self._world, Changes()
        self.simulation.step()
        collided: set[str] = set()
        for crash in world.getCollisions():
            collided |= {crash.collider, crash.victim}
        changes.collided = len(collided)
        freed = []
        # SUMO lists removed vehicles as arrived, too.
        for name in {*world.getArrivedIDList(), *collided}:
            vehicle = self.vehicles.pop(name, None)
            if vehicle is None:  # collided where it entered, now or in the last step
                continue
            changes.arrived += name not in collided
            if vehicle.slot < 0:
                continue
            freed.append(vehicle.slot)
            if name in collided:
                changes.crashed += (vehicle.slot,)
            else:
                changes.left += (vehicle.slot,)
        for name in world.getDepartedIDList():
            changes.entered += 1
            if name not in collided:
                self._add(name, changes)
        # Slots stay empty for a step, in which their vehicles' last observations are returned.
        for slot in freed:
            heapq.heappush(self._free, slot)
        changes.waiting = len(world.getPendingVehicles())
        self._read()
        return changes

    def _add(self, name: str, changes: Changes) -> None:
        slot = -1
        if self._automated(name):
            slot = heapq.heappop(self._free) if self._free else -1
            changes.without_slot += slot < 0
        self.vehicles[name] = Vehicle(slot, speed=self._ask.getSpeed(name))
        config, mode = self.config, self._handed_over
        if mode is None:
            mode = config.av_speed_mode if slot >= 0 else config.hdv_speed_mode
        self._ask.setSpeedMode(name, mode)
        # Only SUMO knows which lanes a route needs.
        self._ask.setLaneChangeMode(name, CHANGE_LANES)

    def _automated(self, name: str) -> bool:
        """Return whether a vehicle that enters is automated, and count it."""
        wanted = self.config.automated_type
        if wanted and self._ask.getTypeID(name) != wanted:
            return False
        edge, share = self._ask.getRoadID(name), self.config.automated_share
        self._entered[edge] += 1
        number = self._entered[edge]
        # Rounded, because 0.1 x 30 is above 3.
        return ceil(round(number * share, 9)) > ceil(round((number - 1) * share, 9))

    def _read(self) -> None:
        ask, network, step_s = self._ask, self.network, self.config.step_s
        row_of, approach, approach_distance = network.lanes.get, network.approach, network.approach_distance
        names = list(self.vehicles)
        rows = [row_of(lane, -1) for lane in map(ask.getLaneID, names)]
        distances = (approach_distance[rows] - np.fromiter(map(ask.getLanePosition, names), float)).tolist()
        self.braking = []
        for vehicle, speed, number, distance in zip(
            self.vehicles.values(), map(ask.getSpeed, names), approach[rows].tolist(), distances, strict=True
        ):
            self.braking.append((vehicle.slot >= 0, (vehicle.speed - speed) / step_s))
            vehicle.speed = speed
            if number == NO_APPROACH:
                # Past its last junction a vehicle keeps its place in the platoon.
                vehicle.distance = min(vehicle.distance, 0.0) - speed * step_s - 1e-6
            else:
                vehicle.approach, vehicle.distance = number, distance

    def vehicles_on(self, lane: str) -> int:
        """Return the number of vehicles on a lane; 0 for an empty name."""
        return int(self.simulation.sumo.lane.getLastStepVehicleNumber(lane)) if lane else 0

    def emissions(self) -> tuple[float, float]:
        """Return the fuel, ml/s, and the CO2, mg/s, of all vehicles now."""
        ask = self._ask
        return (
            sum(map(ask.getFuelConsumption, self.vehicles)),
            sum(map(ask.getCO2Emission, self.vehicles)),
        )
