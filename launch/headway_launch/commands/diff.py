"""`headway diff`: compare the settings and results of two runs."""

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from headway_launch.commands.arguments import add_store_argument, existing_store

if TYPE_CHECKING:
    from headway_launch.console.tables import Value
    from headway_launch.runner.stored_run import StoredRun

EXAMPLES = """\
examples:
  headway diff ippo-108c7d-s0 mappo-437ec5-s0      any unique part of a run's name

Prints the settings, versions and hardware that differ; then status and results of both runs and B minus A:
the summary, and means over the episodes of the last evaluation.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the two runs and the store."""
    parser.add_argument("first", metavar="A", help="name of a run, as in `headway runs`")
    parser.add_argument("second", metavar="B", help="name of the other run")
    add_store_argument(parser)


def execute(arguments: argparse.Namespace) -> int:
    """Print the table of settings and the table of results."""
    from headway_launch.console.tables import print_table
    from headway_launch.runner.stored_run import StoredRun

    root = existing_store(arguments.store)
    pair = [StoredRun.find(root, name) for name in (arguments.first, arguments.second)]
    first, second = (_settings(run) for run in pair)
    names = [run.record.run_id for run in pair]
    rows: list[tuple[Value, ...]] = [
        (name, first.get(name), second.get(name))
        for name in dict.fromkeys((*first, *second))
        if first.get(name) != second.get(name)
    ]
    print_table(("setting", "A", "B"), rows, f"A {names[0]}\nB {names[1]}")
    if not rows:
        print("no settings differ")
    print()
    results: list[tuple[Value, ...]] = [("status", *(run.record.settled_status for run in pair), None)]
    known = [_results(run) for run in pair]
    for name in dict.fromkeys((*known[0], *known[1])):
        a, b = known[0].get(name), known[1].get(name)
        results.append((name, a, b, None if a is None or b is None else b - a))
    print_table(("result", "A", "B", "B minus A"), results)
    return 0


def _settings(run: "StoredRun") -> Mapping[str, str]:
    """Return settings and tags by dotted name, without the store."""
    from headway_launch.experiments.parameters import flat

    mapping = {name: value for name, value in run.mapping.items() if name != "store"}
    return {**{name: str(value) for name, value in flat(mapping)}, **run.record.tags}


def _results(run: "StoredRun") -> Mapping[str, float]:
    from headway.store.run_folder import read_summary

    results: dict[str, Any] = {"iterations": run.record.durable_iteration, **read_summary(run.directory)}
    results["duration_s"] = run.record.duration_s
    numbers = {name: value for name, value in results.items() if isinstance(value, int | float)}
    return {**numbers, **_last_evaluation(run.directory)}


def _last_evaluation(directory: Path) -> dict[str, float]:
    """Return means over each mode's last evaluation, by names such as `last evaluation, greedy: return`."""
    from headway.events import LABELS
    from headway.store.parquet_log import read_rows

    by_mode: dict[str, list[Mapping[str, float | int | str]]] = {}
    for row in read_rows(directory, "evaluation"):
        rows = by_mode.setdefault(str(row["mode"]), [])
        if rows and rows[-1]["iteration"] != row["iteration"]:
            rows.clear()
        rows.append(row)
    return {
        f"last evaluation, {mode}: {name}": sum(float(row[name]) for row in rows) / len(rows)
        for mode, rows in by_mode.items()
        for name in rows[0]
        if name not in LABELS and all(name in row for row in rows)
    }
