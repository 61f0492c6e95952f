"""SUMO network file of the intersection: generation and reading."""

import subprocess
import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

APPROACHES = ("north", "east", "south", "west")
"""Approaches, clockwise."""
TURNS = ("right", "straight", "left")
_EXIT_OF_TURN = {"right": 3, "straight": 2, "left": 1}
"""Number of clockwise steps from the approach to the exit."""
LINKS = (("right", 0), ("straight", 0), ("straight", 1), ("left", 1))
"""Paths (turn, lane) through the junction per approach, in SUMO's order: link = 4 x approach + position."""
ROAD_M = 200.0
"""Length of every road up to the junction, m."""
SPEED_LIMIT = 30.0
"""Speed limit on all roads, m/s."""
_FOLDER = Path(__file__).with_name("networks")


def exit_of(approach: int, turn: str) -> str:
    """Return the name of the exit of a turn."""
    return APPROACHES[(approach + _EXIT_OF_TURN[turn]) % 4]


def network_file(junction: str) -> Path:
    """Return the path of the packaged network with a type of right of way."""
    return _FOLDER / f"{junction}.net.xml"


def nodes_xml(junction: str) -> str:
    """Return the plain nodes for netconvert."""
    ends = zip(APPROACHES, ((0, 200), (200, 0), (0, -200), (-200, 0)), strict=True)
    lines = [f'  <node id="{name}" x="{x}" y="{y}"/>' for name, (x, y) in ends]
    return "\n".join(
        ["<nodes>", f'  <node id="centre" x="0" y="0" type="{junction}"/>', *lines, "</nodes>\n"]
    )


def edges_xml() -> str:
    """Return the plain edges for netconvert. Their length is set, because the geometric one ends at the
    junction's edge."""
    road = f'numLanes="2" speed="{SPEED_LIMIT:g}" length="{ROAD_M:g}"'
    lines = []
    for name in APPROACHES:
        lines.append(f'  <edge id="{name}_in" from="{name}" to="centre" {road}/>')
        lines.append(f'  <edge id="{name}_out" from="centre" to="{name}" {road}/>')
    return "\n".join(["<edges>", *lines, "</edges>\n"])


def build(netconvert: str, junction: str, folder: Path) -> Path:
    """Generate the network in `folder` with the program netconvert (package eclipse-sumo); return its path.

    Raises subprocess.CalledProcessError if netconvert fails.
    """
    (folder / "plain.nod.xml").write_text(nodes_xml(junction), encoding="utf-8")
    (folder / "plain.edg.xml").write_text(edges_xml(), encoding="utf-8")
    made = folder / f"{junction}.net.xml"
    options = ["-n", "plain.nod.xml", "-e", "plain.edg.xml", "-o", made.name, "--no-turnarounds", "true"]
    options += ["--no-internal-links", "false", "--no-warnings", "true"]
    subprocess.run([netconvert, *options], cwd=folder, check=True, capture_output=True)
    return made


@dataclass(frozen=True)
class Network:
    """Properties of a network file that the environment uses; picklable."""

    path: str
    link_length: NDArray[np.float64]
    """(16,) length of each link inside the junction, m."""
    link_speed: NDArray[np.float64]
    """(16,) speed limit of each link inside the junction, m/s."""
    foes: NDArray[np.bool_]
    """(16, 16) whether two links cross or merge."""
    yields: NDArray[np.bool_]
    """(16, 16) whether the first link yields to the second."""
    total_length: float
    """Total length of all edges, including those inside the junction, m."""
    ways: tuple[NDArray[np.float64], ...]
    """Polyline of each link's path with its roads, (points, 3): distance from the start, x and y from the
    centre, m."""

    def place(self, link: int, position: float) -> tuple[float, float]:
        """Return (x, y) in m from the centre at a distance along the path of a link."""
        at, x, y = self.ways[link].T
        return float(np.interp(position, at, x)), float(np.interp(position, at, y))

    @classmethod
    def read(cls, path: Path) -> "Network":
        """Read a network file made by `build`."""
        root = ElementTree.parse(path).getroot()
        lanes = {lane.attrib["id"]: lane for lane in root.iter("lane")}
        onward = {_internal_lane(way): way.get("via") for way in root.iter("connection")}
        length, speed = np.zeros(16), np.zeros(16)
        ways: dict[int, NDArray[np.float64]] = {}
        for way in root.iter("connection"):
            link = _link_of(way)
            if link is None:
                continue
            via: str | None = way.attrib["via"]
            speed[link] = float(lanes[way.attrib["via"]].attrib["speed"])
            passed = [lanes[_internal_lane(way)]]
            while via is not None:
                length[link] += float(lanes[via].attrib["length"])
                passed.append(lanes[via])
                via = onward.get(via)
            ways[link] = _line([*passed, lanes[f"{way.attrib['to']}_{way.attrib['toLane']}"]])
        requests = {int(request.attrib["index"]): request.attrib for request in root.iter("request")}
        foes, yields = (
            np.array([[bit == "1" for bit in reversed(requests[link][name])] for link in range(16)])
            for name in ("foes", "response")
        )
        edges = [edge.find("lane") for edge in root.iter("edge")]
        total = sum(float(lane.attrib["length"]) for lane in edges if lane is not None)
        return cls(str(path), length, speed, foes, yields, total, tuple(ways[link] for link in range(16)))


def _internal_lane(way: ElementTree.Element) -> str:
    """Return the id of the lane at the start of a connection."""
    return f"{way.attrib['from']}_{way.attrib['fromLane']}"


def _line(lanes: list[ElementTree.Element]) -> NDArray[np.float64]:
    """Return the polyline (points, 3) of consecutive lanes. Distances are scaled to each lane's set length,
    which exceeds that of its geometry."""
    points, begin = [], 0.0
    for lane in lanes:
        shape = np.array([pair.split(",") for pair in lane.attrib["shape"].split()], np.float64) - ROAD_M
        steps = np.hypot(*np.diff(shape, axis=0).T)
        length = float(lane.attrib["length"])
        at = begin + length * np.append(0.0, np.cumsum(steps)) / steps.sum()
        points.append(np.column_stack([at, shape]))
        begin += length
    return np.concatenate(points)


def _link_of(way: ElementTree.Element) -> int | None:
    """Return the link of a connection; None unless it starts at an approach."""
    name = way.attrib["from"].removesuffix("_in")
    if name not in APPROACHES:
        return None
    turn = {"r": "right", "s": "straight", "l": "left"}[way.attrib["dir"]]
    return 4 * APPROACHES.index(name) + LINKS.index((turn, int(way.attrib["fromLane"])))
