"""Sentences on what runs started from, in `headway compare` and in reports."""

import json
import re
import shutil
from pathlib import Path

import pytest
import yaml
from command_lines import output
from small_runs import SMALL

from headway.store.parquet_log import read_rows
from headway_launch.commands.main import run
from headway_launch.experiments.start_line import start_line

GREEDY = "evaluation_greedy/return"


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Store with two runs that started from a rule, and one that started from the first of them."""
    root = tmp_path_factory.mktemp("starts")
    words = ["run", "env=trivial", "algo=ippo", "backend=serial", *SMALL, f"store.root={root}"]
    assert run([*words, "seed=0,1", "start.rule=optimal", "start.env_steps=64", "env_steps=192"]) == 0
    assert run([*words, "seed=2", "start.run=-s0-", "study=children"]) == 0
    return root


@pytest.mark.slow
def test_the_imitated_policy_is_given_beside_its_rule(root: Path) -> None:
    folders = sorted((root / "default").glob("*-s*-*"))
    line = start_line("ippo", root, folders, GREEDY)
    points = [
        row[GREEDY] for folder in folders for row in read_rows(folder, "curve") if row["env_steps"] == 64
    ]
    assert len(points) == 2
    # The optimal rule of `trivial` returns its 200 steps.
    mean = f"{sum(points) / 2:.4g}"
    assert line == (
        "ippo started from rule optimal, which acted in the first 64 steps of each run; the policies that "
        f"imitated it then had a mean greedy return of {mean} on the curve's 1 episode, and the rule 200"
    )


def test_the_parent_is_named_with_its_cost(root: Path, tmp_path: Path) -> None:
    [parent] = (root / "default").glob("*-s0-*")
    seconds = json.loads((parent / "summary.json").read_text())["cpu_seconds"]
    words = (
        f"ippo started from run {parent.name} (ippo on trivial), whose 192 steps, {seconds:.4g} CPU s are not"
    )
    out, err = output("compare", "children", "--store", str(root), "--episodes", "2")
    assert words in out + err
    assert run(["report", "children", "--store", str(root), "--out", str(tmp_path)]) == 0
    assert words in re.sub(r"\s+", " ", (tmp_path / "report.html").read_text())


def test_the_run_that_starts_from_another_says_so(root: Path) -> None:
    [parent] = (root / "default").glob("*-s1-*")
    words = ["env=trivial", "algo=ippo", "backend=serial", *SMALL, f"store.root={root}", "study=cousins"]
    out, err = output("run", *words, "seed=5", f"start.run={parent.name}")
    assert f"ippo started from run {parent.name} (ippo on trivial), whose 192 steps" in out + err


def test_what_keeps_policies_near_their_start_is_named(root: Path, tmp_path: Path) -> None:
    [child] = (root / "children").glob("*-s2-*")
    anchored = shutil.copytree(child, tmp_path / child.name)
    config = yaml.safe_load((anchored / "config.yaml").read_text())
    lines = []
    for kl_coeff, critic_iterations in ((0.0, 0), (0.1, 0), (0.1, 2)):
        config["start"].update(kl_coeff=kl_coeff, critic_iterations=critic_iterations)
        (anchored / "config.yaml").write_text(yaml.safe_dump(config))
        lines.append(start_line("ippo", root, [anchored], GREEDY) or "")
    free, penalised, both = lines
    assert penalised == f"{free}; it was kept near that start by start.kl_coeff=0.1"
    assert both == f"{penalised} and start.critic_iterations=2"


def test_a_parent_that_was_deleted_is_no_error(root: Path, tmp_path: Path) -> None:
    shutil.copytree(root / "children", tmp_path / "children")
    [child] = (tmp_path / "children").glob("*-s2-*")
    line = start_line("ippo", tmp_path, [child], GREEDY)
    assert line is not None
    assert line.endswith("which is no longer in the store")


def test_stages_are_named_with_what_they_change(tmp_path: Path) -> None:
    words = ["env=tracking", "algo=ippo", "backend=serial", *SMALL, f"store.root={tmp_path}", "seed=0"]
    stages = "stages=[{env_steps: 60, training_args: {noise: 0.01, effort: 0.2}}, {env_steps: 120}]"
    out, err = output("run", *[word for word in words if not word.startswith("env_steps")], stages)
    line = "ippo was trained in stages: 64 steps with noise=0.01 and effort=0.2, then 128 steps"
    assert line in out + err
    assert run(["report", "default", "--store", str(tmp_path), "--out", str(tmp_path / "page")]) == 0
    page = re.sub(r"\s+", " ", (tmp_path / "page" / "report.html").read_text())
    assert line in page
    assert "vertical lines: the next stage of training begins" in page
