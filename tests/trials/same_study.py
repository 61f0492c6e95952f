"""Comparison of two stores of a study, bit for bit in every curve."""

import sqlite3
from collections import Counter
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

from headway.store.index import RunIndex, RunRow
from headway.store.parquet_log import TABLES, read_rows
from headway.store.run_folder import read_summary


def results_of(table: str) -> list[list[str]]:
    """Return of each cell its name, number of finished runs, reward, deviation and AUC, without costs."""
    return [line.split("\t")[:5] for line in table.splitlines()]


_RESULTS = ("final_reward", "auc", "env_steps")
_CLOCKS = ("wall_s", "time/")
"""Prefixes of columns with durations."""
_COSTS = ("summary/", "time/")
"""Prefixes of metrics that may contain costs."""

_Place = tuple[str, int]
"""(cell, seed)."""


def differences(first: Path, second: Path) -> list[str]:
    """Return one line per difference: runs, statuses, results, every row of every table except durations, and
    MLflow's runs, parameters and curves."""
    found: list[str] = []
    runs = [_by_place(root, found) for root in (first, second)]
    found += [f"{place} is in one store only" for place in runs[0].keys() ^ runs[1].keys()]
    for place in sorted(runs[0].keys() & runs[1].keys()):
        one, other = (found_runs[place] for found_runs in runs)
        checks: dict[str, Callable[[RunRow], Any]] = {
            "status": lambda row: row.status,
            "results": lambda row: {name: read_summary(Path(row.directory)).get(name) for name in _RESULTS},
            **{table: _rows_of(table) for table in TABLES},
        }
        found += [f"{place}: {name} differ" for name, check in checks.items() if check(one) != check(other)]
    return found + _mlflow_differences(first, second, runs)


def _by_place(root: Path, found: list[str]) -> dict[_Place, RunRow]:
    left = _left_by_an_incomplete_stack(root)
    rows = [row for row in RunIndex(root).rows() if row.run_id not in left]
    counts = Counter((row.cell, row.seed) for row in rows)
    found += [f"{place} has {count} runs in {root}" for place, count in counts.items() if count > 1]
    return {(row.cell, row.seed): row for row in rows}


def _left_by_an_incomplete_stack(root: Path) -> set[str]:
    """Return the runs without data of sessions that were killed before they had created all runs of a stack.

    A stack is trained as a whole, so its seeds start anew, and such a run stays, KILLED, beside the new one.
    """
    rows = RunIndex(root).rows()
    counts = Counter((row.cell, row.seed) for row in rows)
    return {
        row.run_id
        for row in rows
        if row.status == "KILLED" and not row.iterations and counts[row.cell, row.seed] > 1
    }


def _rows_of(table: Any) -> Callable[[RunRow], Any]:  # noqa: ANN401 - a name of TABLES
    def rows(run: RunRow) -> list[dict[str, float | int | str]]:
        return [
            {name: value for name, value in row.items() if not name.startswith(_CLOCKS)}
            for row in read_rows(Path(run.directory), table)
        ]

    return rows


def _mlflow_differences(first: Path, second: Path, runs: list[dict[_Place, RunRow]]) -> list[str]:
    found: list[str] = []
    mlflow_data = []
    for root, own in zip((first, second), runs, strict=True):
        names = {row.run_id: place for place, row in own.items()}
        with closing(sqlite3.connect(root / "mlflow.db")) as database:
            mlflow_data.append(_mlflow_data(database, names, found, root))
    for place in sorted(mlflow_data[0].keys() | mlflow_data[1].keys(), key=str):
        one, other = (data.get(place, {}) for data in mlflow_data)
        known = sorted(one.keys() | other.keys())
        found += [f"{place}: MLflow's {name} differs" for name in known if one.get(name) != other.get(name)]
    return found


def _mlflow_data(
    database: sqlite3.Connection, names: dict[str, _Place], found: list[str], root: Path
) -> dict[_Place | str, dict[str, Any]]:
    """Return the MLflow data of each run by (cell, seed), and of each cell by name."""
    data_of: dict[_Place | str, dict[str, Any]] = {}
    query, left = "SELECT run_uuid, name, status FROM runs", _left_by_an_incomplete_stack(root)
    for run, name, status in database.execute(query).fetchall():
        if name in left:
            continue
        place: _Place | str = names.get(name, name)
        if place in data_of:
            found.append(f"{place} is in MLflow twice in {root}")
        params = database.execute("SELECT key, value FROM params WHERE run_uuid = ?", [run]).fetchall()
        points = database.execute("SELECT key, step, value FROM metrics WHERE run_uuid = ?", [run]).fetchall()
        curves = sorted(point for point in points if not point[0].startswith(_COSTS))
        # Energy is logged once by each session that trained the cell.
        repeated = Counter((key, step) for key, step, _ in points if not key.startswith("summary/energy_"))
        found += [f"{place}: {key} at {step} is in MLflow {count} times in {root}"
                  for (key, step), count in repeated.items() if count > 1]  # fmt: skip
        kept = {name for name, _, _ in points if name.startswith("time/")}
        rewards = [value for key, _, value in points if key == "summary/final_reward"]
        data_of[place] = {
            "status": status, "parameters": sorted(params), "curves": curves, "clocks": sorted(kept),
            "final reward": rewards,
        }  # fmt: skip
    return data_of
