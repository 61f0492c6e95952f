"""SUMO networks: the packaged crossing of two roads, and what the environment reads from any network."""

import subprocess
import xml.etree.ElementTree as ElementTree
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from headway.contracts import HeadwayError
from headway_envs.junctions.config import FOUR_WAY
from headway_envs.junctions.files import read_xml

APPROACHES = ("north", "east", "south", "west")
"""Approaches of the packaged network, clockwise."""
ROAD_M, SPEED_LIMIT, GREEN_S = 100.0, 13.0, 25.0
NO_APPROACH = -1
"""Number of the approach of a lane from which no junction is reached."""


def opposite(approach: str) -> str:
    """Return the exit that lies straight ahead."""
    return APPROACHES[(APPROACHES.index(approach) + 2) % 4]


def build(netconvert: str, folder: Path) -> Path:
    """Generate the packaged network in `folder` with the program netconvert (package eclipse-sumo); return
    its path. The north-south road has priority; its traffic light has 25 s of green per road.

    Raises subprocess.CalledProcessError if netconvert fails.
    """
    ends = zip(APPROACHES, ((0, 1), (1, 0), (0, -1), (-1, 0)), strict=True)
    nodes = [f'<node id="{name}" x="{x * ROAD_M}" y="{y * ROAD_M}"/>' for name, (x, y) in ends]
    nodes.append('<node id="centre" x="0" y="0" type="traffic_light"/>')
    edges, connections = [], []
    for link, name in enumerate(APPROACHES):
        road = f'numLanes="1" speed="{SPEED_LIMIT:g}" length="{ROAD_M:g}" priority="{1 - link % 2}"'
        edges.append(f'<edge id="{name}_in" from="{name}" to="centre" {road}/>')
        edges.append(f'<edge id="{name}_out" from="centre" to="{name}" {road}/>')
        lanes = f'from="{name}_in" to="{opposite(name)}_out" fromLane="0" toLane="0"'
        connections.append(f'<connection {lanes} tl="centre" linkIndex="{link}"/>')
    phases = [f'<phase duration="{GREEN_S:g}" state="{state}"/>' for state in ("GrGr", "rGrG")]
    signal = ['<tlLogic id="centre" type="static" programID="0" offset="0">', *phases, "</tlLogic>"]
    files = {"nod": nodes, "edg": edges, "con": connections, "tll": [*signal, *connections]}
    roots = {"nod": "nodes", "edg": "edges", "con": "connections", "tll": "tlLogics"}
    for kind, lines in files.items():
        text = "\n".join([f"<{roots[kind]}>", *lines, f"</{roots[kind]}>\n"])
        (folder / f"plain.{kind}.xml").write_text(text, encoding="utf-8")
    made = folder / f"{FOUR_WAY}.net.xml"
    options = ["-n", "plain.nod.xml", "-e", "plain.edg.xml", "-x", "plain.con.xml", "-i", "plain.tll.xml"]
    options += ["-o", made.name, "--no-turnarounds", "true", "--no-warnings", "true"]
    subprocess.run([netconvert, *options], cwd=folder, check=True, capture_output=True)
    return made


@dataclass(frozen=True)
class Signal:
    """A traffic light. Links are the connections it controls, in the order of its states."""

    off: str
    """State in which vehicles obey the right of way of the junction alone."""
    phases: tuple[tuple[float, str], ...]
    """Duration, s, and state of each phase of its program."""
    offset: float
    """Time by which all phases are later than from the beginning of an episode, s."""
    links: tuple[tuple[str, str], ...]
    """Lane before and lane behind the junction of each link."""


@dataclass(frozen=True)
class Network:
    """Properties of a network with L lanes and G approaches; picklable.

    A junction is a node where paths cross or merge. An approach is a lane that ends at a junction; those of
    one junction are numbered clockwise, in SUMO's order.
    """

    path: str
    lanes: Mapping[str, int]
    """Row of each lane in `approach` and `approach_distance`, lanes inside junctions included."""
    approach: NDArray[np.int64]
    """(L + 1,) approach that is reached next from a lane; NO_APPROACH: none, or it depends on the route."""
    approach_distance: NDArray[np.float64]
    """(L + 1,) distance from the start of a lane to the end of its approach, m. The last row of both arrays
    stands for an unknown lane."""
    approaches: tuple[str, ...]
    """(G,) lane of each approach."""
    others: NDArray[np.int64]
    """(G, K - 1) other approaches of the same junction, clockwise from each; NO_APPROACH where it has fewer.
    K: the most approaches of any junction."""
    speed_limit: float
    """Highest speed limit, m/s."""
    edges: frozenset[str]
    """Edges outside junctions."""
    turns: frozenset[tuple[str, str]]
    """Pairs of edges that follow one another."""
    signals: Mapping[str, Signal]
    """Traffic lights by name."""

    @classmethod
    def read(cls, path: Path) -> "Network":
        """Read a network.

        Raises HeadwayError for a file that is no SUMO network, or one without a junction or without lanes
        inside its junctions.
        """
        root = read_xml(path, "network", ("net",))
        lanes = {lane.attrib["id"]: lane.attrib for edge in root.iter("edge") for lane in edge.iter("lane")}
        ways = [_Way(way.attrib) for way in root.iter("connection")]
        ways = [way for way in ways if lanes[way.before].get("allow") != "pedestrian"]
        after: dict[str, set[str]] = defaultdict(set)
        for way in ways:
            after[way.before].add(way.inside or way.behind)
        junctions = _junctions(root, {way.before for way in ways})
        if not junctions:
            raise HeadwayError(
                f"network {path} has no junction: no node where the paths of vehicles cross or merge"
            )
        approaches = tuple(lane for junction in junctions for lane in junction)
        if any(way.before in approaches and way.inside is None for way in ways):
            raise HeadwayError(
                f"network {path} has no lanes inside its junctions; build it without netconvert's option "
                "--no-internal-links"
            )
        found = _next_approaches(lanes, after, junctions)
        turns = {(way.edge, way.behind_edge) for way in ways}
        return cls(
            path=str(path),
            lanes={lane: row for row, lane in enumerate(lanes)},
            approach=np.array([*(found[lane][0] for lane in lanes), NO_APPROACH]),
            approach_distance=np.array([*(found[lane][1] for lane in lanes), np.inf]),
            approaches=approaches,
            others=_others(junctions),
            speed_limit=max(float(lane["speed"]) for lane in lanes.values()),
            edges=frozenset(
                edge.attrib["id"] for edge in root.iter("edge") if not edge.attrib["id"].startswith(":")
            ),
            turns=frozenset(turn for turn in turns if not turn[0].startswith(":")),
            signals=_signals(root, ways),
        )


class _Way:
    """A connection between two lanes."""

    def __init__(self, attributes: Mapping[str, str]) -> None:
        self.edge, self.behind_edge = attributes["from"], attributes["to"]
        self.before = f"{self.edge}_{attributes['fromLane']}"
        self.behind = f"{self.behind_edge}_{attributes['toLane']}"
        self.inside = attributes.get("via")
        self.signal, self.link = attributes.get("tl"), int(attributes.get("linkIndex", -1))
        self.state = attributes.get("state", "M")


def _junctions(root: ElementTree.Element, leading_on: set[str]) -> list[list[str]]:
    """Return the approaches of each junction, clockwise: lanes of `leading_on` that end at a node where paths
    conflict."""
    found = []
    for node in root.iter("junction"):
        lanes = [lane for lane in node.attrib.get("incLanes", "").split() if lane in leading_on]
        conflict = any("1" in request.attrib["foes"] for request in node.iter("request"))
        approaches = [lane for lane in lanes if not lane.startswith(":")]
        if node.attrib["type"] != "internal" and conflict and len(approaches) > 1:
            found.append(approaches)
    return found


def _next_approaches(
    lanes: Mapping[str, Mapping[str, str]], after: Mapping[str, set[str]], junctions: list[list[str]]
) -> dict[str, tuple[int, float]]:
    """Return the approach reached from each lane, and the distance from the lane's start to its end.

    Where lanes of one junction branch off, the first of them stands for all.
    """
    numbers = [(lane, junction) for junction, row in enumerate(junctions) for lane in row]
    junction_of = {number: junction for number, (_, junction) in enumerate(numbers)}
    length = {lane: float(attributes["length"]) for lane, attributes in lanes.items()}
    found = {lane: (number, length[lane]) for number, (lane, _) in enumerate(numbers)}
    pending = [lane for lane in lanes if lane not in found]
    while pending:
        known = [lane for lane in pending if all(each in found for each in after.get(lane, ()))]
        # What remains are lanes in a circle without a junction.
        for lane in known or pending:
            number, distance = min(
                (found.get(each, (NO_APPROACH, np.inf)) for each in after.get(lane, ())),
                default=(NO_APPROACH, np.inf),
            )
            reached = {junction_of.get(found.get(each, (NO_APPROACH,))[0]) for each in after.get(lane, ())}
            one = number >= 0 and len(reached) == 1
            found[lane] = (number, length[lane] + distance) if one else (NO_APPROACH, np.inf)
        pending = [lane for lane in pending if lane not in found]
    return found


def _others(junctions: list[list[str]]) -> NDArray[np.int64]:
    most = max(map(len, junctions))
    rows, first = [], 0
    for lanes in junctions:
        count = len(lanes)
        for own in range(count):
            others = [first + (own + turn) % count for turn in range(1, count)]
            rows.append(others + [NO_APPROACH] * (most - count))
        first += count
    return np.array(rows, np.int64)


def _signals(root: ElementTree.Element, ways: Sequence[_Way]) -> dict[str, Signal]:
    """Return the traffic lights with connections, each with its first program."""
    found: dict[str, Signal] = {}
    for logic in root.iter("tlLogic"):
        name, offset = logic.attrib["id"], float(logic.attrib.get("offset", 0))
        phases = [(float(phase.attrib["duration"]), phase.attrib["state"]) for phase in logic.iter("phase")]
        links = {way.link: way for way in ways if way.signal == name and way.link >= 0}
        if name in found or not links or not phases:
            continue
        # A link without a connection between lanes is a pedestrian crossing.
        size = len(phases[0][1])
        off = "".join("O" if link not in links or links[link].state == "O" else "o" for link in range(size))
        lanes = [
            (links[link].before, links[link].behind) if link in links else ("", "") for link in range(size)
        ]
        found[name] = Signal(off, tuple(phases), offset, tuple(lanes))
    return found
