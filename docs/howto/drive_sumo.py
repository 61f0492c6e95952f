"""Drive the automated vehicles of Headway's intersection in SUMO by an exported policy, without Headway.

    python drive_sumo.py policy.onnx crossing/intersection.sumocfg 1500 accelerations.csv

The arguments are the policy, SUMO's configuration, the number of steps of 0.1 s and the file to write.
Observations are built by the names, units and scales in the policy's file. Needs numpy, onnxruntime and
libsumo; traci has the same functions (`import traci as libsumo`) and also drives "sumo-gui".
"""

import json
import sys
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import libsumo
import numpy as np
import onnxruntime

STEP_S, ROAD_M, SPEED_LIMIT, MIN_GAP_M, AHEAD_M = 0.1, 200.0, 30.0, 2.5, 200.0
APPROACHES, TURNS = ("north", "east", "south", "west"), ("right", "straight", "straight", "left")
BEYOND = ("before_line", "in_junction", "beyond_junction")


class Policy:
    """The exported policy: its description and its network."""

    def __init__(self, path: str) -> None:
        self.session = onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])
        described = json.loads(self.session.get_modelmeta().custom_metadata_map["headway.json"])
        self.features = [(each["name"], each["scale"]) for each in described["observation_features"]]
        env, inputs = described["origin"]["env"], [each.name for each in self.session.get_inputs()]
        if env["id"] != "intersection" or env.get("wrappers") or inputs != ["observations"]:
            raise ValueError(f"{path} must be a policy of env=intersection without wrappers or recurrence")
        self.slots, self.arguments = len(described["agents"]), env["args"]

    def accelerations(self, quantities: dict[int, dict[str, float]]) -> dict[int, np.float32]:
        """Return the acceleration of each slot, m/s^2, given what its vehicle observes, in units, by name."""
        rows = np.zeros((1, self.slots, len(self.features)), np.float32)
        for slot, observed in quantities.items():
            rows[0, slot] = [observed.get(name, 0.0) / scale for name, scale in self.features]
        [actions] = self.session.run(["actions"], {"observations": rows})
        return {slot: np.float32(actions[0, slot, 0]) for slot in quantities}


@dataclass
class Vehicle:
    """A vehicle on the road."""

    name: str
    link: int
    """Path through the junction, SUMO's index of the connection."""
    slot: int
    """The agent that drives it; -1: SUMO does."""
    offset: float
    """Position on entry minus the distance driven by then, m."""
    speed: float = 0.0
    position: float = 0.0
    """Position of the front along its path, m; the stop line is at ROAD_M."""

    @property
    def left(self) -> float:
        """Distance to the stop line, m; below 0 beyond it."""
        return ROAD_M - self.position

    @property
    def line_time(self) -> float:
        """Time to the stop line at the present speed, s, at most 20; 0 beyond it."""
        return min(max(self.left, 0.0) / max(self.speed, 0.1), 20.0)


class Junction:
    """Paths through the junction: their lengths and conflicts, from SUMO's network file."""

    def __init__(self, network: str) -> None:
        root = ElementTree.parse(network).getroot()
        length = {lane.attrib["id"]: float(lane.attrib["length"]) for lane in root.iter("lane")}
        onward = {f"{way.attrib['from']}_{way.attrib['fromLane']}": way for way in root.iter("connection")}
        ways = {self.link_of(way.attrib["from"], way.attrib["dir"], way.attrib["fromLane"]): way
                for way in root.iter("connection") if way.attrib["from"].endswith("_in")}  # fmt: skip
        self.inside_m = dict.fromkeys(ways, 0.0)
        for link, way in ways.items():
            part = way.get("via")
            while part is not None:
                self.inside_m[link] += length[part]
                part = onward[part].get("via")
        requests = {int(each.attrib["index"]): each.attrib for each in root.iter("request")}
        self.foes, self.yields = (
            {link: [bit == "1" for bit in reversed(requests[link][name])] for link in ways}
            for name in ("foes", "response")
        )

    @staticmethod
    def link_of(edge: str, turn: str, lane: int | str) -> int:
        """Return the path that leads from a lane of an edge such as `north_in` to a turn: r, s or l."""
        place = {"r": 0, "s": 1 + int(lane), "l": 3}[turn]
        return 4 * APPROACHES.index(edge.removesuffix("_in")) + place

    def part(self, vehicle: Vehicle) -> int:
        """Return 0 before the stop line, 1 inside the junction, 2 beyond it."""
        return (vehicle.left <= 0) + (vehicle.left <= -self.inside_m[vehicle.link])

    def conflicts(self, own: Vehicle, vehicles: list[Vehicle]) -> list[Vehicle]:
        """Return the next vehicles on conflicting paths: inside the junction or first on their lane."""
        foes = [each for each in vehicles if self.foes[own.link][each.link]]
        found = [each for each in foes if self.part(each) == 1]
        for lane in range(8):
            queue = [each for each in foes if each.link // 2 == lane and self.part(each) == 0]
            found += [min(queue, key=lambda each: each.left)] if queue else []
        return sorted(found, key=lambda each: each.left / max(each.speed, 3.0))[:4]


class Drive:
    """Vehicles of a running simulation, in order of entry."""

    def __init__(self, policy: Policy, configuration: str) -> None:
        self.policy, self.vehicles = policy, dict[str, Vehicle]()
        libsumo.start(["sumo", "-c", configuration])
        self.junction = Junction(libsumo.simulation.getOption("net-file"))
        self.freed: set[int] = set()
        """Slots freed since the last action, which new vehicles do not take yet."""
        self.arrived = 0

    def run(self, steps: int) -> Iterator[tuple[float, str, float]]:
        """Yield time, s, vehicle and acceleration, m/s^2, of each action."""
        repeat = self.policy.arguments["action_repeat"]
        chosen: dict[int, np.float32] = {}
        for step in range(steps):
            driven = [vehicle for vehicle in self.vehicles.values() if vehicle.slot >= 0]
            if step % repeat == 0:
                self.freed = set()
                chosen = self.policy.accelerations({each.slot: self.observed(each) for each in driven})
                for each in driven:
                    yield step * STEP_S, each.name, float(chosen[each.slot])
            for each in driven:
                change = float(chosen.get(each.slot, np.float32(0)) * np.float32(STEP_S))
                libsumo.vehicle.setSpeed(each.name, max(each.speed + change, 0.0))
            self.step()

    def step(self) -> None:
        """Run 0.1 s of SUMO and read its vehicles. Crashed vehicles are among those that arrived."""
        libsumo.simulationStep()
        for name in libsumo.simulation.getArrivedIDList():
            if (gone := self.vehicles.pop(name, None)) is not None:
                self.freed.add(gone.slot)
                self.arrived += 1
        for name in libsumo.simulation.getDepartedIDList():
            self.vehicles[name] = self.entered(name)
        for name, vehicle in self.vehicles.items():
            vehicle.speed = libsumo.vehicle.getSpeed(name)
            vehicle.position = libsumo.vehicle.getDistance(name) + vehicle.offset

    def entered(self, name: str) -> Vehicle:
        """Return a vehicle that has just entered; automated ones, `av...`, take the lowest free slot."""
        ask, arguments, slot = libsumo.vehicle, self.policy.arguments, -1
        if name.startswith("av"):
            taken = self.freed | {each.slot for each in self.vehicles.values()}
            slot = next((each for each in range(self.policy.slots) if each not in taken), -1)
        if slot >= 0:
            ask.setSpeedMode(name, arguments["av_speed_mode"])
            ask.setLaneChangeMode(name, arguments["av_lane_change_mode"])
        else:
            ask.setSpeedMode(name, arguments["hdv_speed_mode"])
        edge, exit_edge = ask.getRoute(name)
        turned = APPROACHES.index(exit_edge.removesuffix("_out")) - APPROACHES.index(edge.removesuffix("_in"))
        link = Junction.link_of(edge, "?lsr"[turned % 4], ask.getLaneIndex(name))
        return Vehicle(name, link, slot, ask.getLanePosition(name) - ask.getDistance(name))

    def observed(self, own: Vehicle) -> dict[str, float]:
        """Return what a vehicle observes, in units, by name; what is left out is 0."""
        scales = dict(self.policy.features)
        part, speed, left = self.junction.part(own), own.speed, max(own.left, 0.0)
        inside = self.junction.inside_m[own.link]
        quantities = {
            "position": own.position - (0.0, ROAD_M, ROAD_M + inside)[part],
            "speed": speed,
            BEYOND[part]: 1.0,
            "line_distance": left,
            "line_time": own.line_time,
            f"turn_{TURNS[own.link % 4]}": 1.0,
            "near_line_distance": min(left, 50.0),
        }
        leader, lead_gap = libsumo.vehicle.getLeader(own.name, AHEAD_M) or ("", 0.0)
        follower, follow_gap = libsumo.vehicle.getFollower(own.name, AHEAD_M)
        ahead, behind = self.vehicles.get(leader), self.vehicles.get(follower)
        lead = scales["leader_distance"] if ahead is None else lead_gap + MIN_GAP_M
        follow = scales["follower_distance"] if behind is None else follow_gap + MIN_GAP_M
        quantities |= {
            "leader_speed": (SPEED_LIMIT if ahead is None else ahead.speed) - speed,
            "leader_distance": lead,
            "follower_speed": speed - (0.0 if behind is None else behind.speed),
            "follower_distance": follow,
            "near_leader_distance": min(lead, 50.0),
            "leader_headway": 5.0 if ahead is None else min(lead / max(speed, 0.1), 5.0),
            "near_follower_distance": min(follow, 50.0),
        }
        others = self.junction.conflicts(own, list(self.vehicles.values())) if part < 2 else []
        for number, other in enumerate(others, 1):
            seen = {
                "present": 1.0,
                "line_distance": other.left,
                "speed": other.speed,
                "line_time": other.line_time - own.line_time,
                "automated": float(other.slot >= 0),
                "has_priority": float(self.junction.yields[own.link][other.link]),
            }
            quantities |= {f"conflict_{number}_{name}": value for name, value in seen.items()}
        return quantities


def main(words: list[str]) -> None:
    """Drive, and write the accelerations as CSV."""
    try:
        policy, configuration, steps, output = words
        drive = Drive(Policy(policy), configuration)
        with Path(output).open("w", encoding="utf-8") as file:
            print("time,vehicle,acceleration", file=file)
            for time, vehicle, acceleration in drive.run(int(steps)):
                print(f"{time:.1f},{vehicle},{acceleration}", file=file)
    except Exception as error:  # the libraries' errors have no common type
        message = " ".join(str(error).split())
        print(f"drive_sumo.py POLICY.onnx SCENARIO.sumocfg STEPS OUTPUT.csv: {message}", file=sys.stderr)
        raise SystemExit(2) from None
    print(f"{drive.arrived} vehicles arrived or crashed, {len(drive.vehicles)} are on the road; see {output}")


if __name__ == "__main__":
    main(sys.argv[1:])
