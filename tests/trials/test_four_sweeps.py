"""Four concurrent sweeps into one new store lose and duplicate nothing."""

import json
import sqlite3
import subprocess
import sys
from pathlib import Path

import pytest

from headway.store import RunIndex, sync_each
from headway.store.parquet_log import read_curve

pytestmark = pytest.mark.slow

SWEEP = (
    "env=trivial",
    "algo=ippo",
    "study=together",
    "energy=off",
    "backend=serial",
    "backend.parallel=1",
    "env.args.agents=2",
    "env.args.steps=20",
    "rollout.copies=4",
    "rollout.block=2",
    "rollout.steps=16",
    "env_steps=128",
    "evaluation.episodes=1",
    "evaluation.final_episodes=1",
    "evaluation.rules=[]",
)


def test_four_sweeps_at_once_lose_nothing(tmp_path: Path) -> None:
    root = tmp_path / "runs"
    commands = [
        [sys.executable, "-m", "headway_launch", "sweep", *SWEEP, f"seed={seed}", f"store.root={root}"]
        for seed in range(4)
    ]
    sessions = [subprocess.Popen(command, stdout=subprocess.DEVNULL, cwd=tmp_path) for command in commands]
    assert [session.wait(600) for session in sessions] == [0, 0, 0, 0]
    rows = RunIndex(root).rows("together")
    assert sorted((row.seed, row.status) for row in rows) == [(seed, "FINISHED") for seed in range(4)]
    assert all(len(read_curve(Path(row.directory), "evaluation_greedy/return")) == 2 for row in rows)
    sync_each(root)  # send what a busy session had no time for; nothing is sent twice
    with sqlite3.connect(root / "mlflow.db") as database:
        known = dict(database.execute("SELECT name, run_uuid FROM runs").fetchall())
        assert len(database.execute("SELECT run_uuid FROM runs").fetchall()) == 5  # four runs and their cell
        for row in rows:
            told = database.execute(
                "SELECT step, value FROM metrics WHERE run_uuid = ? AND key = 'evaluation_greedy/return'",
                [known[row.run_id]],
            ).fetchall()
            assert dict(told) == read_curve(Path(row.directory), "evaluation_greedy/return")
            assert len(told) == 2
            state = json.loads(Path(row.directory, "tracking.json").read_text())
            assert state["run"] == known[row.run_id]
            assert state["complete"]
