"""Traffic demand: vehicle types, routes and flows for SUMO."""

from headway_envs.intersection.config import IntersectionConfig
from headway_envs.intersection.network import APPROACHES, LINKS, TURNS, exit_of

AV, HDV = "av", "hdv"
MIN_GAP_M = 2.5


def routes_xml(config: IntersectionConfig) -> str:
    """Return the content of a SUMO route file.

    Each vehicle takes one of the two turns of its lane with equal probability, so that none needs a lane
    change. Route ids are `approach_turn`; vehicle ids begin with the type."""
    lines = ["<routes>", _type(HDV, 2.6, 4.5, config), _type(AV, 3.0, 3.0, config)]
    for index, approach in enumerate(APPROACHES):
        for turn in TURNS:
            edges = f"{approach}_in {exit_of(index, turn)}_out"
            lines.append(f'  <route id="{approach}_{turn}" edges="{edges}"/>')
        for lane in (0, 1):
            turns = " ".join(f"{approach}_{turn}" for turn, of_lane in LINKS if of_lane == lane)
            name = f"{approach}{lane}"
            lines.append(f'  <routeDistribution id="{name}" routes="{turns}" probabilities="1 1"/>')
    for approach in APPROACHES:
        for lane in (0, 1):
            lines += _flows(config, f"{approach}{lane}", lane)
    return "\n".join([*lines, "</routes>\n"])


def _type(name: str, acceleration: float, braking: float, config: IntersectionConfig) -> str:
    """Return a vehicle type: SUMO's Intelligent Driver Model with the parameters of Flow's vehicles."""
    return (
        f'  <vType id="{name}" carFollowModel="IDM" accel="{acceleration}" decel="{braking}" tau="1" '
        f'minGap="{MIN_GAP_M}" maxSpeed="30" speedFactor="1" speedDev="0.1" '
        f'impatience="{config.impatience}"/>'
    )


def _flows(config: IntersectionConfig, name: str, lane: int) -> list[str]:
    """Return flows with Poisson arrivals from 1 s on; human drivers enter at 10 m/s, AVs at 5 m/s."""
    kinds = ((HDV, config.vph_per_lane_hdv, 10), (AV, config.vph_per_lane_av, 5))
    return [
        f'  <flow id="{kind}.{name}" type="{kind}" route="{name}" begin="1" period="exp({rate / 3600:.9f})" '
        f'departLane="{lane}" departSpeed="{speed}"/>'
        for kind, rate, speed in kinds
        if rate > 0
    ]
