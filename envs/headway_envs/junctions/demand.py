"""Traffic demand: that of the packaged network, and route files of one's own."""

from itertools import pairwise
from pathlib import Path

from headway.contracts import HeadwayError
from headway_envs.junctions.config import JunctionsConfig
from headway_envs.junctions.network import APPROACHES, Network, opposite, read_xml

_TYPE = (
    '<vType id="car" carFollowModel="IDM" accel="2.6" decel="4.5" tau="1" minGap="2.5" maxSpeed="30" '
    'delta="4" speedFactor="1" speedDev="0.1" impatience="0.5"/>'
)
"""SUMO's Intelligent Driver Model with the parameters of Flow's vehicles, for vehicles of both kinds."""
_DEPARTING = ("vehicle", "trip", "flow")


def routes_xml(config: JunctionsConfig, network: Network) -> str:
    """Return the content of a SUMO route file. Raises HeadwayError for a file that does not fit the
    network."""
    return _read(config, network) if config.vph is None else _even_flows(*config.vph)


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


def _read(config: JunctionsConfig, network: Network) -> str:
    path = Path(config.demand)
    root = read_xml(path, "demand", ("routes", "additional"))
    if not any(True for tag in _DEPARTING for _ in root.iter(tag)):
        raise HeadwayError(f"env.args.demand: {path} has no vehicles: no <vehicle>, <trip> or <flow>")
    types = {each.attrib.get("id") for each in root.iter("vType")}
    if config.automated_type and config.automated_type not in types:
        named = ", ".join(sorted(name for name in types if name)) or "none"
        raise HeadwayError(
            f"env.args.automated_type: {path} has no vType '{config.automated_type}'; it has: {named}"
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
