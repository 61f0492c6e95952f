"""Junctions that are closed after each test, because a process holds one simulation, and networks of one's
own."""

import subprocess
from collections.abc import Callable, Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest

from headway_envs.junctions.config import JunctionsConfig

Open = Callable[..., Any]
Convert = Callable[..., Path]


@pytest.fixture(autouse=True)
def sumo() -> None:
    """Skip all tests without SUMO."""
    if find_spec("libsumo") is None:
        pytest.skip("SUMO (headway[sumo]) is not installed")


@pytest.fixture
def junctions() -> Iterator[Open]:
    """(arguments of the configuration) -> environment, closed after the test."""
    from headway_envs.junctions.env import JunctionsBatchedEnv
    from headway_envs.junctions.prepared import prepare

    opened = []

    def open_one(**arguments: Any) -> JunctionsBatchedEnv:  # noqa: ANN401 - any argument
        env = JunctionsBatchedEnv(prepare(JunctionsConfig(**arguments)), 1)
        opened.append(env)
        return env

    yield open_one
    for env in opened:
        env.close()


@pytest.fixture
def tool(tmp_path: Path) -> Convert:
    """(program of SUMO, arguments) -> network that it has made, in the test's folder."""
    home = Path(pytest.importorskip("sumo", reason="netconvert (package eclipse-sumo) is missing").SUMO_HOME)

    def make(program: str, *arguments: str) -> Path:
        made = tmp_path / "made.net.xml"
        command = [str(home / "bin" / program), *arguments, "-o", made.name, "--no-warnings", "true"]
        subprocess.run(command, cwd=tmp_path, check=True, capture_output=True)
        return made

    return make


@pytest.fixture
def grid(tool: Convert, tmp_path: Path) -> tuple[Path, Path]:
    """Network of three by two junctions with traffic lights, and a demand across it."""
    network = tool(
        "netgenerate", "--grid", "--grid.x-number", "3", "--grid.y-number", "2", "--grid.length", "120",
        "--grid.attach-length", "80", "--default-junction-type", "traffic_light", "--no-turnarounds", "true",
    )  # fmt: skip
    demand = tmp_path / "grid.rou.xml"
    trips = {
        "left0A0 C0right0": 400,
        "right0C0 A0left0": 300,
        "bottom0A0 A1top0": 300,
        "top2C1 C0bottom2": 300,
    }
    lines = [
        '<flow id="{}" from="{}" to="{}" begin="0" vehsPerHour="{}"/>'.format(number, *ends.split(), vph)
        for number, (ends, vph) in enumerate(trips.items())
    ]
    demand.write_text("\n".join(["<routes>", *lines, "</routes>"]), encoding="utf-8")
    return network, demand


NODES = """<nodes>
<node id="west" x="-100" y="0"/><node id="bend" x="-60" y="20"/><node id="mid" x="0" y="0" type="priority"/>
<node id="east" x="150" y="0"/><node id="south" x="0" y="-90"/>
</nodes>"""
EDGES = """<edges>
<edge id="main1" from="west" to="bend" numLanes="1" speed="15" priority="2"/>
<edge id="main2" from="bend" to="mid" numLanes="1" speed="15" priority="2"/>
<edge id="exit" from="mid" to="east" numLanes="1" speed="15" priority="2"/>
<edge id="side" from="south" to="mid" numLanes="1" speed="10" priority="1"/>
</edges>"""
DEMAND = """<routes>
<vType id="robot" accel="3"/><vType id="person" accel="2"/>
<route id="along" edges="main1 main2 exit"/><route id="join" edges="side exit"/>
<flow id="a" type="person" route="along" begin="0" vehsPerHour="500"/>
<flow id="b" type="robot" route="join" begin="0" vehsPerHour="500"/>
</routes>"""


@pytest.fixture
def merge(tool: Convert, tmp_path: Path) -> tuple[Path, Path]:
    """Hand-made network: a side road that joins a main road behind a bend, and its demand."""
    (tmp_path / "n.nod.xml").write_text(NODES, encoding="utf-8")
    (tmp_path / "e.edg.xml").write_text(EDGES, encoding="utf-8")
    network, demand = tool("netconvert", "-n", "n.nod.xml", "-e", "e.edg.xml"), tmp_path / "my.rou.xml"
    demand.write_text(DEMAND, encoding="utf-8")
    return network, demand
