"""The packaged network equals netconvert's, and networks are read as SUMO reads them."""

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest

from headway_envs.junctions.config import JunctionsConfig
from headway_envs.junctions.demand import routes_xml
from headway_envs.junctions.files import FOUR_WAY_FILE
from headway_envs.junctions.network import NO_APPROACH, Network, build
from headway_envs.sumo_simulation import libsumo

Open = Callable[..., Any]
Convert = Callable[..., Path]
SEED = np.array([3], np.uint64)


def _content(path: Path) -> str:
    """Return the content without the comment, which holds a date and options."""
    return ElementTree.canonicalize(
        re.sub(r"<!--.*?-->", "", path.read_text(), flags=re.DOTALL), strip_text=True
    )


def test_the_packaged_network_equals_netconverts(tmp_path: Path) -> None:
    sumo = pytest.importorskip("sumo", reason="netconvert (package eclipse-sumo) is not installed")
    made = build(str(Path(sumo.SUMO_HOME, "bin", "netconvert")), tmp_path)
    assert _content(made) == _content(Path(Network.read(FOUR_WAY_FILE).path))


def test_the_packaged_network_has_four_approaches_clockwise() -> None:
    network = Network.read(FOUR_WAY_FILE)
    names = ("north", "east", "south", "west")
    assert network.approaches == tuple(f"{name}_in_0" for name in names)
    assert network.others.tolist() == [[1, 2, 3], [2, 3, 0], [3, 0, 1], [0, 1, 2]]
    assert network.speed_limit == 13
    for number, name in enumerate(names):
        row = network.lanes[f"{name}_in_0"]
        assert (network.approach[row], network.approach_distance[row]) == (number, 100)
        assert network.approach[network.lanes[f"{name}_out_0"]] == NO_APPROACH
        assert network.approach[network.lanes[f":centre_{number}_0"]] == NO_APPROACH
    [signal] = network.signals.values()
    assert signal.off == "OoOo"
    assert signal.links[0] == ("north_in_0", "south_out_0")
    assert signal.phases == ((25.0, "GrGr"), (25.0, "rGrG"))


def test_a_traffic_light_that_is_off_equals_a_priority_junction(junctions: Open, tmp_path: Path) -> None:
    config = JunctionsConfig(demand="500x500")
    lights = Path(Network.read(FOUR_WAY_FILE).path).read_text(encoding="utf-8")
    (tmp_path / "lights.net.xml").write_text(lights, encoding="utf-8")
    plain = re.sub(r"<tlLogic.*</tlLogic>", "", lights, flags=re.DOTALL)
    plain = re.sub(r' tl="centre" linkIndex="\d"', "", plain).replace("traffic_light", "priority")
    plain = plain.replace('state="O"', 'state="M"').replace('state="o"', 'state="m"')
    (tmp_path / "plain.net.xml").write_text(plain, encoding="utf-8")
    (tmp_path / "even.rou.xml").write_text(
        routes_xml(config, Network.read(FOUR_WAY_FILE), ())[0], encoding="utf-8"
    )
    driven = []
    for name in ("lights", "plain"):
        env = junctions(network=str(tmp_path / f"{name}.net.xml"), demand=str(tmp_path / "even.rou.xml"))
        env.reset(SEED)
        env.traffic.hand_over(31)
        speeds = []
        for _ in range(600):
            env.step(np.ones((1, 96), np.int64))
            speeds.append({name: vehicle.speed for name, vehicle in env.traffic.vehicles.items()})
        driven.append(speeds)
        env.close()
    assert driven[0] == driven[1]


def test_distances_equal_sumos_in_a_grid(junctions: Open, grid: tuple[Path, Path]) -> None:
    """SUMO knows the distance to the next traffic light, which all junctions of the grid have."""
    env, sumo, compared = junctions(network=str(grid[0]), demand=str(grid[1])), libsumo(), 0
    env.reset(SEED)
    network = env.prepared.network
    assert len(network.signals) == 6
    assert network.others.shape == (24, 3)
    for _ in range(300):
        env.step(np.ones((1, 96), np.int64))
        for name, vehicle in env.traffic.vehicles.items():
            ahead = sumo.vehicle.getNextTLS(name)
            if ahead:
                compared += 1
                assert vehicle.distance == pytest.approx(ahead[0][2], abs=1e-6)
                assert network.approaches[vehicle.approach].removesuffix("_0").endswith(ahead[0][0])
            else:
                assert vehicle.distance < 0
    assert compared > 2000


def test_lanes_of_pedestrians_are_no_approaches(tool: Convert) -> None:
    walks = ("--sidewalks.guess", "true", "--crossings.guess", "true")
    network = Network.read(tool("netgenerate", "--grid", "--grid.number", "3", *walks))
    assert not any(lane.endswith("_0") for lane in network.approaches)  # lane 0 is the sidewalk
    assert len(network.approaches) == 24  # of edges between the nine nodes


def test_a_road_is_followed_through_a_bend(merge: tuple[Path, Path]) -> None:
    network = Network.read(merge[0])
    assert set(network.approaches) == {"main2_0", "side_0"}
    first, second = network.lanes["main1_0"], network.lanes["main2_0"]
    assert network.approach[first] == network.approach[second]
    assert network.approach_distance[first] > network.approach_distance[second] + 40
    assert network.approach[network.lanes["exit_0"]] == NO_APPROACH
    assert not network.signals
