"""A merge in highway-env 1.12.1 with the road, vehicles, speeds and drivers of one of Headway's.

Deliberate differences from highway-env's defaults: no speed limit (default 20 m/s, which the study's code
ignores); the study's five target speeds of CAVs; with two ramp lanes no changes to the right, and a gain
added to a change between equally good lanes.
"""

import math
from typing import Any

import numpy as np
from highway_env.road.lane import SineLane, StraightLane
from highway_env.road.road import Road, RoadNetwork
from highway_env.vehicle.behavior import IDMVehicle
from highway_env.vehicle.controller import MDPVehicle
from highway_env.vehicle.objects import Obstacle
from numpy.typing import NDArray

LaneIndex = tuple[str, str, int]
TARGET_SPEEDS = np.linspace(10.0, 30.0, 5)
ACTIONS = ("LANE_LEFT", "IDLE", "LANE_RIGHT", "FASTER", "SLOWER")


class LeftOnly(RoadNetwork):  # type: ignore[misc]  # highway-env comes without types
    """Road network without changes to lanes on the right."""

    def side_lanes(self, lane_index: LaneIndex) -> list[LaneIndex]:
        return [lane for lane in super().side_lanes(lane_index) if lane[2] < lane_index[2]]


class LeftOnlyCav(MDPVehicle):  # type: ignore[misc]  # highway-env comes without types
    """CAV that ignores changes to the right."""

    def act(self, action: str | None = None) -> None:
        super().act("IDLE" if action == "LANE_RIGHT" else action)


class Driver(IDMVehicle):  # type: ignore[misc]  # highway-env comes without types
    """Human driver; `GAIN_WHERE_EQUAL` is the gain if the acceleration is equal on both lanes."""

    GAIN_WHERE_EQUAL = 0.0

    def mobil(self, lane_index: LaneIndex) -> bool:
        if super().mobil(lane_index):
            return True
        ahead, behind = self.road.neighbour_vehicles(self, lane_index)
        if self.acceleration(behind, self) < -self.LANE_CHANGE_MAX_BRAKING_IMPOSED:
            return False
        here, _ = self.road.neighbour_vehicles(self)
        equal = self.acceleration(self, ahead) == self.acceleration(self, here)
        return bool(equal and self.GAIN_WHERE_EQUAL >= self.LANE_CHANGE_MIN_ACC_GAIN)


def network(ramp_lanes: int) -> RoadNetwork:
    """Return the road with the study's dimensions."""
    net = RoadNetwork() if ramp_lanes == 1 else LeftOnly()

    def straight(begin: float, end: float, y: float, forbidden: bool = False) -> StraightLane:
        return StraightLane([begin, y], [end, y], speed_limit=None, forbidden=forbidden)

    def sine(y: float) -> SineLane:
        shape = {"amplitude": 3.25, "pulsation": math.pi / 100.0, "phase": math.pi / 2.0}
        return SineLane([220, y], [320, y], **shape, speed_limit=None, forbidden=True)

    net.add_lane("a", "b", straight(0, 320, 0))
    net.add_lane("b", "c", straight(320, 420, 0))
    net.add_lane("b", "c", straight(320, 420, 4, forbidden=ramp_lanes == 1))
    if ramp_lanes == 2:
        net.add_lane("b", "c", straight(320, 420, 8, forbidden=True))
    net.add_lane("c", "d", straight(420, 520, 0))
    net.add_lane("j", "k", straight(0, 220, 10.5, forbidden=True))
    net.add_lane("k", "b", sine(7.25))
    if ramp_lanes == 2:
        net.add_lane("m", "n", straight(0, 220, 14.5, forbidden=True))
        net.add_lane("n", "b", sine(11.25))
    return net


class Oracle:
    """highway-env's road with the vehicles of one copy of Headway's environment."""

    def __init__(
        self, cars: NDArray[Any], cavs: int, ramp_lanes: int, constants: dict[str, float], all_human: bool
    ) -> None:
        """`cars`: CAR records at the start of an episode (CAVs first, no obstacles); `constants`: attributes
        of the drivers; `all_human`: CAVs drive as human drivers."""
        net = network(ramp_lanes)
        self.road = Road(network=net, vehicles=[], road_objects=[], np_random=np.random.default_rng(0))
        for ramp in range(1, ramp_lanes + 1):
            self.road.objects.append(Obstacle(self.road, [420.0, 4.0 * ramp]))
        driver = type("DriverOfThisTrial", (Driver,), constants)
        cav = MDPVehicle if ramp_lanes == 1 else LeftOnlyCav
        for index, car in enumerate(cars):
            place = {"position": [car["x"], car["y"]], "heading": car["heading"], "speed": car["speed"]}
            if index < cavs and not all_human:
                vehicle = cav(self.road, **place, target_speeds=TARGET_SPEEDS)
            else:
                vehicle = driver(self.road, **place)
            self.road.vehicles.append(vehicle)
        self.cavs = 0 if all_human else cavs
        self.lane_numbers = {name: number for number, name in enumerate(net.lanes_dict())}

    def act(self, actions: NDArray[np.int64]) -> None:
        """Apply the actions of the CAVs."""
        for vehicle, action in zip(self.road.vehicles[: self.cavs], actions, strict=False):
            vehicle.act(ACTIONS[action])

    def step(self, dt: float) -> None:
        """Run one simulation step."""
        self.road.act()
        self.road.step(dt)

    @property
    def motion(self) -> NDArray[np.float64]:
        """(vehicles, 6): x, y, heading, speed, and displacement (x, y) by an imminent contact."""
        rows = [
            [*v.position, v.heading, v.speed, *((0.0, 0.0) if v.impact is None else v.impact)]
            for v in self.road.vehicles
        ]
        return np.array(rows)

    @property
    def lanes(self) -> NDArray[np.int64]:
        """(vehicles, 2): lane and target lane."""
        number = self.lane_numbers
        return np.array([[number[v.lane_index], number[v.target_lane_index]] for v in self.road.vehicles])

    @property
    def crashed(self) -> NDArray[np.bool_]:
        """(vehicles,)"""
        return np.array([v.crashed for v in self.road.vehicles])

    def allowed(self, index: int) -> set[int]:
        """Return the actions that highway-env allows a CAV."""
        from types import SimpleNamespace

        from highway_env.envs.common.action import DiscreteMetaAction

        env = SimpleNamespace(vehicle=self.road.vehicles[index], road=self.road)
        return set(DiscreteMetaAction(env, target_speeds=TARGET_SPEEDS).get_available_actions())
