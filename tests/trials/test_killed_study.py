"""A study killed at random points gives the results of an uninterrupted one; small version of the trial."""

import json
import random
import shutil
import signal
import sqlite3
from pathlib import Path

import pytest

from headway.store.index import RunIndex
from tests.trials import killed_study
from tests.trials.killed_study import BASE, Kill, trial
from tests.trials.same_study import differences

pytestmark = pytest.mark.slow

SMALL = (
    *(word for word in BASE if not word.startswith("algo=")),
    "algo=ippo,ia2c",
    "seed=0",
    "backend.parallel=1",
    "env_steps=2400",
    "rollout.copies=2",
    "rollout.block=1",
    "rollout.steps=10",
    "store.checkpoint_every=10",
    "evaluation.every=1000000",
    "evaluation.rules=[]",
    "evaluation.episodes=1",
    "evaluation.final_episodes=1",
    "evaluation.modes=[greedy]",
    "energy=off",
)


def test_a_killed_study_equals_the_uninterrupted_one_and_differences_are_detected(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert trial(tmp_path, SMALL, kills=2, chance=random.Random(1)) == []
    assert "the session had already ended" not in capsys.readouterr().out

    # The comparison detects a lost row, a point sent twice and a duplicate run.
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    first, second = RunIndex(killed).rows()
    segment = next(Path(first.directory).glob("curve-*.parquet"))
    segment.unlink()
    with sqlite3.connect(killed / "mlflow.db") as database:
        database.execute("UPDATE metrics SET step = step + 1 WHERE key LIKE 'policy/%'")
    shutil.copytree(second.directory, f"{second.directory}-again")
    summary = Path(first.directory, "summary.json")
    summary.write_text(json.dumps(json.loads(summary.read_text()) | {"final_reward": 1.0}))
    found = "\n".join(differences(whole, killed))
    assert "curve differ" in found
    assert "MLflow's curves differs" in found
    assert "has 2 runs" in found
    assert "results differ" in found


def test_a_trial_without_a_killed_session_fails(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(killed_study, "_headway", lambda command: ["true"])
    monkeypatch.setattr(killed_study, "_iterations", lambda root: 10)
    with pytest.raises(SystemExit, match="ended before it was killed"):
        trial(tmp_path, SMALL, kills=2, chance=random.Random(5))
    assert capsys.readouterr().out.count("the session had already ended at 10 of 10 iterations") == 2


def test_strike_reports_whether_the_session_was_alive(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(killed_study, "_headway", list)
    monkeypatch.setattr(killed_study, "_iterations", lambda root: 10)
    kill = Kill("session", signal.SIGKILL)
    assert killed_study._strike(["sleep", "60"], tmp_path, 5, kill, random.Random(5))
    assert not killed_study._strike(["true"], tmp_path, 5, kill, random.Random(5))
