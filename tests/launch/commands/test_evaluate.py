"""`headway evaluate`: its formats, and environments with other arguments than those of the training."""

import csv
import json
from pathlib import Path

import pytest
from command_lines import output, refused, rows_of
from kept_policies import keep_run_on
from shuttle import SHUTTLE
from small_runs import SMALL, stored_rows

from headway.contracts import HeadwayError
from headway_launch.commands.main import run
from headway_launch.runner.stored_run import StoredRun, with_env_keys


@pytest.mark.slow
def test_a_policy_and_the_rules_play_the_changed_environment(empty_folder: Path) -> None:
    """Agent i of `SHUTTLE` is paid (i + 1) x fare at each step; the return is the mean over agents."""
    Path("shuttle.py").write_text(SHUTTLE)
    words = ("run", "env=./shuttle.py", "algo=ippo", *SMALL, "env.shared_reward=false")
    assert run([*words, "algo.policies=shared", "algo.agent_id=false"]) == 0
    assert run([*words, "algo.policies=independent"]) == 0
    shared, independent = (row.run_id for row in stored_rows())

    def returns(name: str, *changes: str) -> list[float]:
        rows = rows_of("evaluate", name, "--episodes=2", *changes)
        return [float(row[2]) for row in rows[1:]]

    assert returns(shared) == [7.5, 7.5]
    assert returns(shared, "env.args.fare=2", "env.args.steps=4") == [12.0, 12.0]
    assert returns(shared, "env.args.cars=3") == [10.0, 10.0]
    assert returns(independent, "env.args.fare=0.5") == [3.75, 3.75]
    line = "headway: evaluated on a changed environment: env.args.fare=2 (trained with 1.0)\n"
    assert line in output("evaluate", shared, "--episodes=2", "env.args.fare=2").err
    assert "with env.args.cars=3, observations, actions or agents have other shapes" in refused(
        "evaluate", independent, "env.args.cars=3"
    )
    assert "env.args.fair is not a key of" in refused("evaluate", shared, "env.args.fair=2")

    study = ("compare", stored_rows()[0].study, "--episodes=2", "--where", "policies=shared")
    header, learner, _ = rows_of(*study, "env.args.fare=2", "env.args.steps=4")
    assert dict(zip(header, learner, strict=True))["return"] == "12"
    assert "with env.args.cars=3, observations" in refused(*study[:3], "env.args.cars=3")
    assert "only env.args.KEY=VALUE can be changed" in refused(*study, "algo.lr=3")


def test_its_formats_are_those_of_compare(empty_folder: Path) -> None:
    name = keep_run_on(empty_folder / "runs", ("env=tracking", "env.args.steps=7", "algo=ippo")).name
    asked = ("evaluate", name, "--episodes=3", "--seed=5", "--rules=random,optimal")
    listed = json.loads(output(*asked, "--format=json").out)
    compared = ("compare", "kept", *asked[2:], "--metrics=return,length,distance", "--format=json")
    assert {row["controller"] for row in listed} == {"ippo", "rule random", "rule optimal"}
    assert [row for row in listed if row["metric"] == "return"] == [
        row for row in json.loads(output(*compared).out) if row["metric"] == "return"
    ]
    exact = csv.DictReader(output(*asked, "--format=csv").out.splitlines())
    assert [float(row["mean"]) for row in exact] == [row["mean"] for row in listed]
    page = " ".join(output(*asked, "--format=markdown").out.split())
    assert "paired by episode" in page
    assert f"Written by `headway {' '.join(asked)} --format=markdown`. | controller |" in page
    alone = output(*asked[:3], "--rules=,", "--format=markdown").out
    assert "Differences" not in alone
    assert "| ippo |" in alone
    assert output(*asked, "--format=latex").out.count("\\toprule") == 1


@pytest.mark.parametrize(
    ("override", "line"),
    [
        ("algo.lr=3", "algo.lr=3: a trained policy keeps its own configuration; only env.args"),
        ("env.training_args.reward=1", "only env.args.KEY=VALUE can be changed"),
        ("env=merge", "only env.args.KEY=VALUE can be changed"),
        ("env.args.steps", "only env.args.KEY=VALUE can be changed"),
        ("env.args.steps=1,2", "env.args.steps=1,2: give one value"),
        ("env.args.steps=[", "is not valid in Hydra's grammar"),
        ("env.args.steps.more=2", "env.args.steps has no keys; give its value"),
    ],
)
def test_other_changes_are_one_line(override: str, line: str, tmp_path: Path) -> None:
    stored = StoredRun.read(tmp_path, keep_run_on(tmp_path, ("env=tracking", "algo=ippo")))
    with pytest.raises(HeadwayError) as caught:
        stored.with_env_args([override])
    assert line in str(caught.value)


def test_nested_arguments_are_changed_and_others_kept() -> None:
    stored = {"env": {"id": "x", "args": {"reward": {"kind": "own", "scale": 1.0}, "day": 2}}, "seed": [1]}
    overrides = ["env.args.reward.scale=0.5", "env.args.day=null", "env.args.names=[a,'b c']"]
    changed, changes = with_env_keys(stored, overrides)
    args = {"reward": {"kind": "own", "scale": 0.5}, "day": None, "names": ["a", "b c"]}
    assert changed == {"env": {"id": "x", "args": args}, "seed": [1]}
    assert changes[0] == "env.args.reward.scale=0.5 (trained with 1.0)"
    assert stored["env"]["args"]["day"] == 2  # type: ignore[index]
