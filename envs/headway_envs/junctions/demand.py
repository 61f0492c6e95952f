"""Traffic demand: that of the packaged network, and route files of one's own."""

from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

from headway.contracts import HeadwayError
from headway_envs.junctions.config import JunctionsConfig
from headway_envs.junctions.files import read_xml
from headway_envs.junctions.network import APPROACHES, Network, opposite

_TYPE = (
    '<vType id="car" carFollowModel="IDM" accel="2.6" decel="4.5" tau="1" minGap="2.5" maxSpeed="30" '
    'delta="4" speedFactor="1" speedDev="0.1" impatience="0.5"/>'
)
"""SUMO's Intelligent Driver Model with the parameters of Flow's vehicles, for vehicles of both kinds."""
_DEPARTING = ("vehicle", "trip", "flow")


def routes_xml(config: JunctionsConfig, network: Network, files: Sequence[Path]) -> tuple[str, ...]:
    """Return the content of a SUMO route file for each demand; `files`: route files, if the demand has any.
    Raises HeadwayError for a file that does not fit the network."""
    own = tuple(_read(path, config.automated_type, network) for path in files)
    return own or tuple(_even_flows(*vph) for vph in config.vph)


def _even_flows(horizontal: int, vertical: int) -> str:
    """Return flows of evenly spaced vehicles, from 1 s on and in phase, that start from a standstill."""
    lines = ["<routes>", _TYPE]
    lines += [f'<route id="{name}" edges="{name}_in {opposite(name)}_out"/>' for name in APPROACHES]
    for name in APPROACHES:
        vph = vertical if name in ("north", "south") else horizontal
        lines.append(
            f'<flow id="{name}" type="car" route="{name}" begin="1" end="86400" vehsPerHour="{vph}" '
            'departSpeed="0" departLane="random"/>'
        )
    return "\n".join([*lines, "</routes>\n"])


def _read(path: Path, automated_type: str, network: Network) -> str:
    root = read_xml(path, "demand", ("routes", "additional"))
    if not any(True for tag in _DEPARTING for _ in root.iter(tag)):
        raise HeadwayError(f"env.args.demand: {path} has no vehicles: no <vehicle>, <trip> or <flow>")
    types = {each.attrib.get("id") for each in root.iter("vType")}
    if automated_type and automated_type not in types:
        named = ", ".join(sorted(name for name in types if name)) or "none"
        raise HeadwayError(
            f"env.args.automated_type: {path} has no vType '{automated_type}'; it has: {named}"
        )
    for element in root.iter():
        edges = element.attrib.get("edges", "").split() if element.tag == "route" else []
        ends = [
            element.attrib[key]
            for key in ("from", "to")
            if element.tag in _DEPARTING and key in element.attrib
        ]
        for edge in (*edges, *ends):
            if edge not in network.edges:
                raise HeadwayError(f"env.args.demand: {path} names edge '{edge}', which {network.path} lacks")
        for pair in pairwise(edges):
            if pair not in network.turns:
                raise HeadwayError(
                    f"env.args.demand: {path} has a route over edges '{pair[0]}' and '{pair[1]}', which "
                    f"{network.path} does not connect"
                )
    return path.read_text(encoding="utf-8")
