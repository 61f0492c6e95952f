"""docs/howto/drive_sumo.py drives SUMO without Headway as Headway's environment does with the same policy."""

import csv
import os
import subprocess
import sys
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from kept_policies import keep_run_on

from headway.api import load_policy
from headway_envs.api import IntersectionConfig, write_sumo_scenario
from headway_envs.registry import ENTRIES
from headway_launch.commands.main import run

SCRIPT = Path(__file__).resolve().parents[2] / "docs" / "howto" / "drive_sumo.py"
ALONE = """\
import runpy, sys
class NoHeadway:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0].startswith("headway"):
            raise ImportError(f"{name} is not to be imported")
sys.meta_path.insert(0, NoHeadway())
sys.argv = sys.argv[1:]
runpy.run_path(sys.argv[0], run_name="__main__")
"""
"""Program that runs another one where Headway cannot be imported."""
Accelerations = dict[tuple[float, str], float]
"""Accelerations by time, s, and vehicle."""

BRIEFLY = (
    "seed=3", "env_steps=200", "rollout.copies=1", "rollout.block=1", "rollout.steps=200", "energy=off",
    "evaluation.episodes=1", "evaluation.final_episodes=1", "evaluation.rules=[]", "backend=serial",
)  # fmt: skip


@pytest.fixture(autouse=True)
def _packages(empty_folder: Path) -> None:
    for package in ("libsumo", "onnx", "onnxruntime"):
        pytest.importorskip(package)


def script(*words: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-c", ALONE, str(SCRIPT), *map(str, words)]
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    return subprocess.run(command, env=environment, capture_output=True, text=True, check=False)


def driven_by_headway(policy_file: Path, config: IntersectionConfig, seed: int, steps: int) -> Accelerations:
    """Return the actions of the environment's vehicles, each with its vehicle's name in SUMO."""
    policy, entry, found = load_policy(policy_file), ENTRIES["intersection"], Accelerations()
    with closing(entry.make(entry.prepare(config), 1)) as made:
        env: Any = made
        observed = env.reset(np.array([seed], np.uint64))
        for step in range(steps):
            if step % config.action_repeat:
                continue
            actions, _ = policy.act(observed.observations[0])
            for _, slot, name in env.bridge.roster.automated:
                found[round(step * 0.1, 1), name] = float(actions[slot, 0])
            _, observed = env.step(actions[None].astype(np.float32))
    return found


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arguments", "trained"),
    [({}, True), ({"observation": "paper", "action_repeat": 5}, False)],
    ids=["extended", "paper"],
)
def test_accelerations_are_the_environments(arguments: dict[str, Any], trained: bool, tmp_path: Path) -> None:
    """Three simulated minutes, in which vehicles enter, cross, leave and crash."""
    steps, config = 1800, IntersectionConfig(horizon=2000, **arguments)
    words = [f"env.args.{key}={value}" for key, value in {"horizon": 2000, **arguments}.items()]
    words += ["env=intersection", "algo=ippo", "algo.policies=shared"]
    name = "s3" if trained else keep_run_on(tmp_path / "runs", words).name
    if trained:
        assert run(["run", *words, *BRIEFLY]) == 0
    assert run(["export", name, "--format", "onnx", "--output", "policy.onnx"]) == 0
    scenario = write_sumo_scenario(config, "crossing", seed=3)
    done = script("policy.onnx", scenario, steps, "accelerations.csv")
    assert (done.returncode, done.stderr) == (0, "")
    rows = csv.DictReader(Path("accelerations.csv").read_text(encoding="utf-8").splitlines())
    found = {(float(row["time"]), row["vehicle"]): float(row["acceleration"]) for row in rows}
    expected = driven_by_headway(Path("policy.onnx"), config, 3, steps)
    assert found.keys() == expected.keys()
    assert len(found) > 1000
    assert int(done.stdout.split(" vehicles")[0].split()[-1]) > 5  # arrived or crashed
    assert found == pytest.approx(expected, abs=1e-5)


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (("policy.onnx",), "drive_sumo.py POLICY.onnx SCENARIO.sumocfg STEPS OUTPUT.csv: "),
        (("nowhere.onnx", "a.sumocfg", "10", "out.csv"), "nowhere.onnx"),
        (("policy.onnx", "a.sumocfg", "10", "out.csv"), "policy.onnx must be a policy of env=intersection"),
    ],
)
def test_what_it_cannot_use_is_one_line(words: tuple[str, ...], says: str, tmp_path: Path) -> None:
    folder = keep_run_on(tmp_path / "runs", ["env=tracking", "algo=ippo"])
    assert run(["export", folder.name, "--format", "onnx", "--output", "policy.onnx"]) == 0
    done = script(*words)
    assert done.returncode == 2
    assert says in done.stderr
    assert done.stderr.count("\n") == 1
