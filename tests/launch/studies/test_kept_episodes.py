"""Stored episodes of best policies: what storing those of some runs does to those of others."""

from pathlib import Path
from typing import Any

import pytest
from small_runs import SMALL
from stored_runs import keep_run

from headway.events import Row
from headway.store.atomic_files import read_json
from headway.store.run_folder import best_file
from headway_launch.experiments.compose import compose
from headway_launch.runner.stored_run import StoredRun
from headway_launch.studies.kept_episodes import keep_episodes


@pytest.fixture
def runs(tmp_path: Path) -> list[StoredRun]:
    """Return two runs of one cell."""
    experiment = compose(("env=trivial", "algo=ippo", *SMALL))
    return [
        StoredRun.find(tmp_path, keep_run(tmp_path, experiment, seed, "FINISHED", 1, final_reward=1.0))
        for seed in range(2)
    ]


def keep(
    run: StoredRun, value: float, rule: str, count: int = 3, root: int = 7, mode: str = "greedy"
) -> None:
    rows: list[Row] = [{"return": value}] * count
    keep_episodes([run], [1], [rows], {rule: rows}, root, mode)


def kept(run: StoredRun) -> tuple[dict[str, float], dict[str, float]]:
    """Return the returns that are kept for runs and rules."""
    content = read_json(best_file(run.store, run.record.study, run.record.cell))
    rules = {rule: rows[0]["return"] for rule, rows in content["rules"].items()}
    return {name: own["episodes"][0]["return"] for name, own in content["runs"].items()}, rules


def test_runs_and_rules_that_were_not_selected_keep_their_episodes(runs: list[StoredRun]) -> None:
    names = [run.record.run_id for run in runs]
    keep(runs[0], 1.0, "random")
    keep(runs[1], 2.0, "optimal")
    assert kept(runs[0]) == ({names[0]: 1.0, names[1]: 2.0}, {"random": 1.0, "optimal": 2.0})
    keep(runs[0], 3.0, "random")
    assert kept(runs[0]) == ({names[0]: 3.0, names[1]: 2.0}, {"random": 3.0, "optimal": 2.0})


@pytest.mark.parametrize("other", [{"count": 4}, {"root": 8}, {"mode": "sampled"}])
def test_other_episodes_replace_all_and_a_line_says_so(
    other: dict[str, Any], runs: list[StoredRun], capsys: pytest.CaptureFixture[str]
) -> None:
    keep(runs[0], 1.0, "random")
    keep(runs[0], 1.0, "random", count=5)
    assert not capsys.readouterr().err
    keep(runs[1], 2.0, "optimal", **other)
    assert kept(runs[0]) == ({runs[1].record.run_id: 2.0}, {"optimal": 2.0})
    reason = "they were played with another --episodes, --seed or --mode"
    said = f"removed the kept episodes of 1 other run and 1 other rule: {reason}"
    assert said in capsys.readouterr().err
    keep(runs[1], 2.0, "random")
    assert f"removed the kept episodes of 1 other rule: {reason}" in capsys.readouterr().err
    best_file(runs[0].store, "toys", runs[0].record.cell).write_text('{"runs": 1}')
    keep(runs[0], 1.0, "random")
    assert kept(runs[0]) == ({runs[0].record.run_id: 1.0}, {"random": 1.0})
