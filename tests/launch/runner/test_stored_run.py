"""Stored configurations, and the policies of stored runs: newest, best, and not finite."""

import json
from pathlib import Path

import numpy as np
import pytest
from command_lines import output, refused
from small_runs import SMALL

from headway.api import load_policy
from headway.contracts import Box, HeadwayError
from headway.store.checkpoint import load_latest, save_checkpoint
from headway.store.parquet_log import read_rows
from headway.store.run_configuration import read_configuration
from headway.store.run_folder import CHECKPOINTS
from headway_launch.commands.main import run
from headway_launch.runner.checkpointed_policy import policy_episodes, stored_policy
from headway_launch.runner.stored_run import StoredRun

TINY = (
    "run", "env=tracking", "algo=ippo", *SMALL, "backend=serial", "env.args.steps=8", "env_steps=256",
    "algo.model.hidden=[8]", "store.checkpoint_every=1", "evaluation.every=64", "evaluation.episodes=2",
    "evaluation.rules=[]",
)  # fmt: skip
pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("empty_folder")]


@pytest.mark.parametrize("piece", ["[", "[ ", "- ", "{a: "])
def test_a_configuration_nested_without_end_is_one_line(piece: str, tmp_path: Path) -> None:
    (tmp_path / "config.yaml").write_text(piece * 100_000)
    with pytest.raises(HeadwayError, match="it is nested more than 100 levels deep"):
        read_configuration(tmp_path)


def test_a_configuration_whose_store_is_no_mapping_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "config.yaml").write_text("store: ../..")
    with pytest.raises(
        HeadwayError, match=r"config\.yaml: store=\.\./\.\. is not a mapping; restore the file"
    ):
        StoredRun.read(tmp_path, tmp_path)


def _only_run() -> StoredRun:
    [record] = Path("runs").glob("*/*/run.json")
    return StoredRun.read(Path("runs"), record.parent)


def _returns(stored: StoredRun) -> list[float]:
    """Returns of the recorded evaluation after the last iteration."""
    rows = read_rows(stored.directory, "evaluation")
    return [float(row["return"]) for row in rows if row["iteration"] == 4 and row["mode"] == "greedy"]


def test_a_stored_policy_acts_in_scaled_units() -> None:
    assert run(list(TINY)) == 0
    stored = _only_run()
    policy = stored_policy(stored, stored.experiment.prepare())
    assert policy.plan.spec.action_space == Box((-1.0, -1.0), (1.0, 1.0))
    root = stored.experiment.config.evaluation.seed
    assert [row["return"] for row in policy_episodes(policy, root, 2, greedy=True)] == _returns(stored)


def test_the_best_policy_is_played_and_exported_in_the_place_of_the_newest() -> None:
    """The best policies are replaced by others than the newest, so that what is taken shows."""
    assert run(list(TINY)) == 0
    stored = _only_run()
    newest, state, _ = load_latest(stored.directory / CHECKPOINTS)
    state["best"]["iterations"][:] = 2
    for array in state["best"]["acting"].values():
        array += 0.25
    save_checkpoint(stored.directory / CHECKPOINTS, newest, state)
    environment, name = stored.experiment.prepare(), stored.record.run_id
    best = stored_policy(stored, environment, best=True)
    assert best.iteration == 2
    mean = np.mean([float(row["return"]) for row in policy_episodes(best, 2_000_003, 3, greedy=True)])
    others = policy_episodes(stored_policy(stored, environment), 2_000_003, 3, greedy=True)
    assert abs(mean - np.mean([float(row["return"]) for row in others])) > 1e-3

    asked = ["--best", "--episodes", "3", "--rules", "random", "--format", "json"]
    learner = json.loads(output("evaluate", name, *asked).out)[0]
    assert learner["controller"].endswith(", best policy (iteration 2)")
    assert learner["mean"] == pytest.approx(mean, rel=1e-6)
    learner = json.loads(output("compare", stored.record.study, *asked).out)[0]
    assert learner["controller"].endswith(", best policies")
    assert learner["mean"] == pytest.approx(mean, rel=1e-6)
    assert "best policy, of iteration 2" in output("export", name, "--best").err
    Path(f"{name}-best.npz").rename("best.npz")
    by_file, by_folder = load_policy("best.npz"), load_policy(stored.directory, best=True)
    assert by_file.origin["iteration"] == by_folder.origin["iteration"] == 2
    assert load_policy(stored.directory).origin["iteration"] == newest
    assert "--best has no effect if rules" in refused("compare", "env=tracking", "--best")
    with pytest.raises(HeadwayError, match="a file holds one policy"):
        load_policy("best.npz", best=True)


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_policy_that_is_not_finite_is_refused_and_that_of_another_seed_is_not(value: float) -> None:
    """Both seeds were trained in one process, and their policies lie in one array."""
    assert run(["sweep", *TINY[1:], "seed=0,1", "backend.stack=2"]) == 0
    runs = {
        stored.record.seed: stored
        for record in Path("runs").glob("*/*/run.json")
        if (stored := StoredRun.read(Path("runs"), record.parent))
    }
    for stored in runs.values():
        iteration, state, _ = load_latest(stored.directory / CHECKPOINTS)
        name, array = next(iter(state["acting"].items()))
        array[-1].flat[0] = value
        save_checkpoint(stored.directory / CHECKPOINTS, iteration, state)
    environment = runs[0].experiment.prepare()
    stored_policy(runs[0], environment)
    problem = f"run {runs[1].record.run_id} diverged: its policy's {name} is not finite"
    with pytest.raises(HeadwayError, match=problem):
        stored_policy(runs[1], environment)
