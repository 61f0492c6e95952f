"""Query times of a large store."""

import json
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from statistics import median

from headway.store.parquet_log import RunLog
from headway.store.query import select
from headway.store.run_folder import Process, RunRecord, cell_name, create_run_folder, now

RUNS, POINTS = 450, 400
"""Number of runs, as of nine algorithms with fifty seeds each, and number of points per curve."""
ROUNDS = 5


def report() -> None:
    """Print the query times."""
    print(f"\n## Store: {RUNS} runs of {POINTS} points\n")
    with tempfile.TemporaryDirectory() as folder:
        make_store(Path(folder))
        for name, arguments in (
            ("runs", []),
            ("runs, filtered and sorted", ["--where", "final_reward>300", "--sort", "final_reward desc"]),
        ):
            command = [sys.executable, "-m", "headway_launch", "runs", "--store", folder, *arguments]
            first, *others = [_seconds(command) for _ in range(1 + ROUNDS)]
            print(f"headway {name}: {median(others):.2f} s, first run {first:.2f} s")
        began = time.perf_counter()
        read = len(select(folder).curves(["evaluation_greedy/return"]))
        print(f"one metric of all curves, {read:,} rows: {time.perf_counter() - began:.2f} s")
        (Path(folder) / "index.sqlite").unlink()
        command = [sys.executable, "-m", "headway_launch", "runs", "--store", folder]
        print(f"headway runs without its index: {_seconds(command):.2f} s", flush=True)


def make_store(root: Path, runs: int = RUNS, points: int = POINTS) -> None:
    """Fill a store with synthetic finished runs: nine cells with `runs` / 9 seeds each."""
    for number in range(runs):
        algorithm, seed = f"algorithm_{number % 9}", number // 9
        parameters = {f"algo.parameter_{index}": str(index) for index in range(40)}
        run_id, directory = create_run_folder(root, "large", cell_name("bus", algorithm, parameters), seed)
        record = RunRecord(
            run_id, "large", "bus", algorithm, seed, points, now(), Process.current(), "FINISHED",
            "shared", now(), 60.0, points, points * 4096, parameters,
        )  # fmt: skip
        replace(record, session=Process("elsewhere", 1, 0.0)).write(directory)
        summary = {"final_reward": 250.0 + number % 100, "auc": 0.7, "cpu_seconds": 60.0, "kwh": 0.001}
        (directory / "summary.json").write_text(json.dumps({**summary, "kg_co2": 1e-4}))
        (directory / "config.yaml").write_text(json.dumps({"seed": [seed], "algo": {"name": algorithm}}))
        (directory / "plan.json").write_text(json.dumps({"stack": [seed], "workers": 1}))
        log = RunLog(directory)
        rows = [
            {
                "iteration": at,
                "env_steps": 4096 * at,
                "wall_s": 0.15 * at,
                "evaluation_greedy/return": float(at),
            }
            for at in range(points)
        ]
        log.append("curve", rows)
        log.commit(points)


def _seconds(command: list[str]) -> float:
    began = time.perf_counter()
    subprocess.run(command, capture_output=True, check=True)
    return time.perf_counter() - began
