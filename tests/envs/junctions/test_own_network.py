"""Networks and demand of one's own: they run, and what is wrong with them is one line."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from headway.contracts import HeadwayError
from headway_envs.junctions.config import JunctionsConfig
from headway_envs.junctions.parallel import JunctionsSlotsParallelEnv
from headway_envs.junctions.prepared import prepare
from headway_envs.junctions.renderer import HUMAN, JunctionsRenderer
from headway_envs.sumo_simulation import libsumo

Open = Callable[..., Any]
Files = tuple[Path, Path]
SEED = np.array([3], np.uint64)


def test_vehicles_cross_a_grid_and_leave(junctions: Open, grid: Files) -> None:
    env, left = junctions(network=str(grid[0]), demand=str(grid[1]), horizon=400), 0
    assert env.spec.observation_size == 22
    assert env.spec.state_size == 3 * 24 + 1
    observed = env.reset(SEED)
    for _ in range(400):
        outcome, observed = env.step(np.full((1, 96), 2))
        assert np.isfinite(observed.observations).all()
        assert np.abs(observed.observations).max() <= 1
        left += outcome.truncated.any() and not outcome.episode_ended[0]
    assert left > 10


def test_only_vehicles_of_the_type_are_automated(junctions: Open, merge: Files) -> None:
    files = {"network": str(merge[0]), "demand": str(merge[1]), "slots": 20}
    env, sumo = junctions(**files, automated_type="robot", automated_share=1.0), libsumo()
    assert env.spec.observation_size == 10
    env.reset(SEED)
    for _ in range(100):
        env.step(np.full((1, 20), 1))
    kinds = {
        sumo.vehicle.getTypeID(name): vehicle.slot >= 0 for name, vehicle in env.traffic.vehicles.items()
    }
    assert kinds == {"robot": True, "person": False}


def test_vehicles_without_room_wait(junctions: Open, merge: Files) -> None:
    network, demand = merge
    demand.write_text(demand.read_text(encoding="utf-8").replace('"500"', '"3000"'), encoding="utf-8")
    env = junctions(network=str(network), demand=str(demand), slots=20, horizon=200, warm_up_s=0)
    env.reset(SEED)
    for _ in range(200):
        outcome, _ = env.step(np.full((1, 20), 1))
    assert dict(zip(env.spec.metrics, outcome.metrics[0].tolist(), strict=True))["waiting"] > 10


def test_more_approaches_than_the_network_has_look_empty(junctions: Open, merge: Files) -> None:
    files = {"network": str(merge[0]), "demand": str(merge[1]), "slots": 20}
    env = junctions(**files, approaches=4)
    observed = env.reset(SEED)
    assert env.spec.observation_size == 22
    distances = observed.observations[0, observed.alive[0]][:, 5:11]
    assert (distances == [-1, 1, 1] * 2).all()


def test_pictures_show_vehicles_on_their_roads(junctions: Open, merge: Files) -> None:
    env = junctions(network=str(merge[0]), demand=str(merge[1]), lead_in_s=0)
    env.reset(SEED)
    renderer = JunctionsRenderer(env.prepared)
    empty = renderer.render(env, at_end=False)
    for _ in range(60):
        env.step(np.full((1, 96), 1))
    full = renderer.render(env, at_end=False)
    assert empty.shape == full.shape == (640, 640, 3)
    changed = (empty != full).any(axis=2)[60:]
    assert changed.sum() > 200
    assert (np.abs(full[60:][changed].astype(int) - HUMAN).max(axis=1) < 20).sum() > 50
    assert (renderer.render(env, at_end=True) == full).all()


def test_the_parallel_env_has_slots_as_agents() -> None:
    face = JunctionsSlotsParallelEnv(JunctionsConfig(horizon=20, slots=30))
    face.reset(seed=1)
    while face.agents:
        seen, rewards, *_, infos = face.step(dict.fromkeys(face.agents, 2))
        assert len(set(rewards.values())) == 1
        assert all(face.observation_space(name).contains(row) for name, row in seen.items())
    assert "outflow_vph" in infos["av_0"]["episode_metrics"]
    assert face.render().shape == (640, 640, 3)
    face.close()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"network": "nowhere.net.xml"}, r"args\.network: cannot read /.*/nowhere\.net\.xml: No such file"),
        ({"network": "{demand}"}, r"network: .*my\.rou\.xml must be a SUMO file <net>, not one of <routes>"),
        ({"demand": "{network}"}, r"demand: .*made\.net\.xml must be a SUMO file <routes>, not one of <net>"),
        ({"automated_type": "car"}, r"automated_type: .* has no vType 'car'; it has: person, robot"),
        ({"approaches": 2, "demand": "{demand}"}, None),
    ],
)  # fmt: skip
def test_unusable_files_are_one_line(changes: dict[str, Any], message: str | None, merge: Files) -> None:
    names = {"network": str(merge[0]), "demand": str(merge[1])}
    given = {
        key: value.format(**names) if isinstance(value, str) else value for key, value in changes.items()
    }
    config = JunctionsConfig(**{**names, **given})
    if message is None:
        prepare(config)
        return
    with pytest.raises(HeadwayError, match=message) as raised:
        prepare(config)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize(
    ("before", "after", "message"),
    [
        (
            'edges="side exit"',
            'edges="side main2"',
            "route over edges 'side' and 'main2', which .* not connect",
        ),
        ('edges="side exit"', 'edges="lane exit"', "names edge 'lane', which .*made.net.xml lacks"),
        ("<flow", "<!-- <flow", "is not XML"),
        ("flow", "route", "has no vehicles: no <vehicle>, <trip> or <flow>"),
    ],
)
def test_unusable_demand_is_one_line(before: str, after: str, message: str, merge: Files) -> None:
    demand = merge[1]
    demand.write_text(demand.read_text(encoding="utf-8").replace(before, after), encoding="utf-8")
    with pytest.raises(HeadwayError, match=f"env.args.demand: .*{message}"):
        prepare(JunctionsConfig(network=str(merge[0]), demand=str(demand)))


def test_a_network_without_junctions_or_their_lanes_is_refused(
    tool: Callable[..., Path], merge: Files
) -> None:
    demand = str(merge[1])
    plain = tool("netconvert", "-n", "n.nod.xml", "-e", "e.edg.xml", "--no-internal-links", "true")
    with pytest.raises(HeadwayError, match="no lanes inside its junctions; build it without netconvert's"):
        prepare(JunctionsConfig(network=str(plain), demand=demand))
    edges = merge[0].with_name("e.edg.xml")
    edges.write_text(edges.read_text().replace('<edge id="side" ', "<!--").replace('priority="1"/>', "-->"))
    line = tool("netconvert", "-n", "n.nod.xml", "-e", "e.edg.xml")
    with pytest.raises(HeadwayError, match="has no junction: no node where the paths of vehicles cross or"):
        prepare(JunctionsConfig(network=str(line), demand=demand))


def test_a_demand_that_sumo_refuses_is_an_error_of_the_environment(junctions: Open, merge: Files) -> None:
    demand = merge[1]
    demand.write_text(demand.read_text().replace('type="robot"', 'type="bus"'), encoding="utf-8")
    env = junctions(network=str(merge[0]), demand=str(demand))
    with pytest.raises(HeadwayError, match=r"SUMO cannot load the network or the demand: .*bus"):
        env.reset(SEED)


def test_a_trip_without_a_route_is_an_error_of_the_environment(junctions: Open, merge: Files) -> None:
    demand = merge[1]
    demand.write_text('<routes><trip id="a" depart="0" from="exit" to="side"/></routes>', encoding="utf-8")
    env = junctions(network=str(merge[0]), demand=str(demand), lead_in_s=0)
    env.reset(SEED)
    with pytest.raises(HeadwayError, match="SUMO stopped the episode: Vehicle 'a' has no valid route"):
        env.step(np.full((1, 96), 1))


def test_vehicles_that_collide_where_they_enter_are_gone_and_have_not_left(
    junctions: Open, merge: Files
) -> None:
    vehicle = '<vehicle id="{0}" route="join" depart="{0}" departPos="{1}" departSpeed="0" {2}/>'
    unchecked = 'insertionChecks="none"'
    vehicles = "".join(vehicle.format(*row, unchecked) for row in ((1, 30), (2, 31)))
    route = '<route id="join" edges="side exit"/>'
    merge[1].write_text(f"<routes>{route}{vehicles}</routes>", encoding="utf-8")
    files = {"network": str(merge[0]), "demand": str(merge[1])}
    env = junctions(**files, automated_share=1.0, slots=4, lead_in_s=0, warm_up_s=0, horizon=20)
    env.reset(SEED)
    paid, ended = [], 0
    for _ in range(20):
        outcome, _ = env.step(np.full((1, 4), 2))
        paid.append(float(outcome.rewards[0, 0]))
        ended += int(outcome.terminated.sum())
    assert sorted(paid) == [-10.0] + [0.0] * 19
    assert ended == 1  # the other has never acted
    found = dict(zip(env.spec.metrics, outcome.metrics[0].tolist(), strict=True))
    assert (found["collided_vehicles"], found["outflow_vph"]) == (2, 0)
    assert found["inflow_vph"] == 2 * 3600 / 10
    assert 0 <= found["speed"] < 15
