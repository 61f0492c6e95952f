"""A policy trained at one SUMO network plays on another, as docs/howto/sumo_network.md has it."""

import json
from importlib.util import find_spec
from pathlib import Path

import pytest
from kept_policies import keep_run_on
from small_runs import end_as

from headway_envs.junctions.config import JunctionsConfig
from headway_envs.junctions.demand import routes_xml
from headway_envs.junctions.files import FOUR_WAY_FILE
from headway_envs.junctions.network import Network
from headway_launch.commands.main import run

pytestmark = pytest.mark.skipif(find_spec("libsumo") is None, reason="SUMO (headway[sumo]) is not installed")


def test_a_policy_plays_on_another_network(empty_folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    network = Network.read(FOUR_WAY_FILE)
    text = Path(network.path).read_text(encoding="utf-8")
    Path("my.net.xml").write_text(text.replace('speed="13.00"', 'speed="20.00"'), encoding="utf-8")
    [routes] = routes_xml(JunctionsConfig(demand="300x300"), network, ())
    Path("my.rou.xml").write_text(routes, encoding="utf-8")
    words = ["env=junctions", "env.args.approaches=6", "env.args.horizon=200", "env.args.warm_up_s=0"]
    name = keep_run_on(empty_folder / "runs", [*words, "algo=ippo", "algo.policies=shared"]).name
    other = ("env.args.network=my.net.xml", "env.args.demand=my.rou.xml")
    capsys.readouterr()
    assert run(["evaluate", name, "--episodes=1", "--rules=human,signal", "--format=json", *other]) == 0
    rows = json.loads(capsys.readouterr().out)
    means = {(row["metric"], row["controller"]): row["mean"] for row in rows}
    assert means["outflow_vph", "rule human"] > 800
    assert run(["render", name, "--output", "picture.png"]) == 0
    assert Path("picture.png").stat().st_size > 1000
    assert run(["evaluate", name, *other, "env.args.approaches=3"]) == 2
    assert "approaches must be at least 4 for network my.net.xml" in capsys.readouterr().err


def test_a_run_is_not_continued_on_a_changed_network(
    empty_folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """`evaluate` says that the network has changed, unless another is given. Comments do not change it."""
    network, demand = Path("my.net.xml"), Path("my.rou.xml")
    text = FOUR_WAY_FILE.read_text(encoding="utf-8")
    network.write_text(text, encoding="utf-8")
    read = Network.read(FOUR_WAY_FILE)
    [routes] = routes_xml(JunctionsConfig(demand="300x300"), read, ())
    demand.write_text(routes, encoding="utf-8")
    files = [f"env.args.network={network}", f"env.args.demand={demand}"]
    words = [*files, "env.args.horizon=40", "env.args.warm_up_s=0", "algo=ippo", "algo.policies=shared"]
    folder = keep_run_on(empty_folder / "runs", ["env=junctions", *words])
    evaluate = ["evaluate", folder.name, "--episodes=1", "--rules=human"]
    end_as(folder)
    told = "a file of env=junctions is not that of the run's training"
    for changed, equal in ((f"{text}<!-- made again -->", True), (text.replace("13.00", "20.00"), False)):
        network.write_text(changed, encoding="utf-8")
        assert run(evaluate) == 0
        assert (told not in capsys.readouterr().err) == equal
    assert run([*evaluate, "env.args.horizon=50"]) == 0
    assert told in capsys.readouterr().err
    Path("other.net.xml").write_text(text.replace("13.00", "30.00"), encoding="utf-8")
    assert run([*evaluate, "env.args.network=other.net.xml"]) == 0
    printed = capsys.readouterr().err
    assert "evaluated on a changed environment: env.args.network=other.net.xml (trained with" in printed
    assert told not in printed
    assert run(["resume", folder.name]) == 2
    line = "a file of env=junctions has changed since its digest"
    assert line in capsys.readouterr().err
