"""Files that a configuration names: SUMO's own configurations, several demands, and digests."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from headway.contracts import HeadwayError
from headway_envs.junctions.config import JunctionsConfig
from headway_envs.junctions.entry import ENTRY
from headway_envs.junctions.files import digest
from headway_envs.junctions.prepared import prepare
from headway_envs.sumo_simulation import libsumo

Open = Callable[..., Any]
Files = tuple[Path, Path]
SEED = np.array([3], np.uint64)
MIXED = ("300x1500", "1500x300")
CONFIGURATION = """<configuration>
<input><net-file value="made.net.xml"/><route-files value="my.rou.xml"/></input>
<time><begin value="0"/></time>
</configuration>"""


@pytest.fixture
def sumocfg(merge: Files) -> Path:
    path = merge[0].with_name("my.sumocfg")
    path.write_text(CONFIGURATION, encoding="utf-8")
    return path


def test_a_sumo_configuration_stands_for_its_files(sumocfg: Path, merge: Files) -> None:
    """Its paths are relative to its folder."""
    own = prepare(JunctionsConfig(network=str(sumocfg)))
    plain = prepare(JunctionsConfig(network=str(merge[0]), demand=str(merge[1])))
    assert (own.network.path, own.routes) == (plain.network.path, plain.routes)
    assert own.notices == (f"{sumocfg}: only its network and its routes are used, not begin",)
    other = merge[1].with_name("other.rou.xml")
    other.write_text(merge[1].read_text(encoding="utf-8").replace('"500"', '"50"'), encoding="utf-8")
    [routes] = prepare(JunctionsConfig(network=str(sumocfg), demand=str(other))).routes
    assert routes == other.read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("before", "after", "message"),
    [
        ("net-file", "net", r"network: .*my\.sumocfg has no net-file"),
        ("route-files", "routes", "must have one file as route-files, not none; join several into one"),
        ("my.rou.xml", "my.rou.xml,b.rou.xml", r"route-files, not my\.rou\.xml,b\.rou\.xml; join"),
        ("made.net", "nowhere.net", r"network: cannot read .*nowhere\.net\.xml: No such file"),
        ("my.rou", "nowhere.rou", r"demand: cannot read .*nowhere\.rou\.xml: No such file"),
        ("configuration", "net", r"must be a SUMO file <configuration>, not one of <net>"),
    ],
)
def test_an_unusable_sumo_configuration_is_one_line(
    before: str, after: str, message: str, sumocfg: Path
) -> None:
    sumocfg.write_text(CONFIGURATION.replace(before, after), encoding="utf-8")
    with pytest.raises(HeadwayError, match=message) as raised:
        prepare(JunctionsConfig(network=str(sumocfg)))
    assert "\n" not in str(raised.value)


def test_each_episode_draws_one_of_several_demands(junctions: Open) -> None:
    """The traffic of the two demands differs by direction. The same seed draws the same demands."""
    env, sumo = junctions(demand=MIXED, horizon=2, warm_up_s=0), libsumo()
    drawn: list[list[int]] = []
    for _ in range(2):
        env.reset(SEED)
        drawn.append([])
        for _ in range(10):
            vertical = sum(name.startswith(("north", "south")) for name in sumo.vehicle.getIDList())
            more_vertical = 2 * vertical > len(sumo.vehicle.getIDList())
            assert more_vertical == (env.demand == 0)
            drawn[-1].append(env.demand)
            for _ in range(2):
                env.step(np.full((1, 96), 2))
    assert drawn[0] == drawn[1]
    assert set(drawn[0]) == {0, 1}


def test_a_list_of_one_demand_is_that_demand(junctions: Open) -> None:
    seen = []
    for demand in ("400x600", ("400x600",)):
        env = junctions(demand=demand)
        seen.append(env.reset(SEED).observations.copy())
        env.close()
    np.testing.assert_array_equal(*seen)


def test_the_best_greens_are_those_of_the_episodes_demand(junctions: Open) -> None:
    """400x1000 has 11 and 25 s, 700x700 twice 25 s."""
    demands, sumo = ("400x1000", "700x700"), libsumo()
    env, found = junctions(demand=demands, horizon=110), {}
    rule, observed = ENTRY.rules["signal_best"].make(env.prepared), env.reset(SEED)
    while len(found) < 2:
        demand, states = env.demand, []
        for _ in range(110):
            actions = rule.act(env, observed)
            states.append(sumo.trafficlight.getRedYellowGreenState("centre"))
            _, observed = env.step(actions)
        found[demand] = states.count("GrGr"), states.count("rGrG")
    # A cycle of 72 steps, then 38 of the next; one of 100, then 10.
    assert found == {0: (50 + 38, 22), 1: (50 + 10, 50)}


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"demand": ()}, "demand must not be empty"),
        ({"demand": ("700x700", "")}, "demand must not be empty"),
        ({"demand": ("700x700", "my.rou.xml")}, "demand must be either route files or vehicles per hour"),
        ({"demand": ("700x700", "0x700")}, "demand must have numbers between 1 and 3,600"),
        ({"network": "my.net.xml", "demand": ("a.rou.xml", "700x700")}, "demand must be a route file"),
    ],
)
def test_unusable_lists_are_refused(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        JunctionsConfig(**arguments)


def test_the_digest_is_of_contents_without_comments(merge: Files, sumocfg: Path) -> None:
    network, demand = merge
    config = JunctionsConfig(network=str(network), demand=str(demand))
    first = digest(config)
    assert first is not None
    assert first == digest(JunctionsConfig(network=str(sumocfg)))
    moved = network.with_name("moved.net.xml")
    moved.write_bytes(network.read_bytes())
    assert first == digest(JunctionsConfig(network=str(moved), demand=str(demand)))
    text = demand.read_text(encoding="utf-8")
    for changed, equal in (("<!-- generated\nagain -->" + text, True), (text.replace("500", "501"), False)):
        demand.write_text(changed, encoding="utf-8")
        assert (digest(config) == first) == equal
    demand.unlink()
    assert digest(config) is None
    assert digest(JunctionsConfig()) is None
