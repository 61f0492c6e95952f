"""`headway runs`: list the runs in the store."""

import argparse
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict, fields

from headway.config.schema import parse_seeds, suggestion
from headway.contracts.errors import HeadwayError
from headway.store.index import RunIndex, RunRow
from headway.store.run_folder import STATUSES
from headway_launch.commands.arguments import (
    add_format_argument,
    add_store_argument,
    add_where_argument,
    existing_store,
)
from headway_launch.console.tables import Value, print_table
from headway_launch.runner.results import AUC_HEADING, CO2_HEADING

EXAMPLES = """\
examples:
  headway runs
  headway runs --study bus --algo mappo --status FINISHED
  headway runs --seed 0..4 --format csv > runs.csv
  headway runs --format json | jq '.[].final_reward'
  headway runs --columns seed,algo.lr,final_reward
  headway runs --where 'final_reward>300 and algo.lr<1e-3' --sort 'final_reward desc'
  headway diff RUN RUN                             settings and results of two runs side by side

The table has the columns that most readers want, and up to four settings in which runs of one study,
environment, algorithm and preset differ; a line below it (on stderr, if piped) names the columns left out.
Conditions are SQL expressions (and, or, not, in, between, like). They, --sort and --columns use the field
names of --format csv, also cell, directory, host, pid and created, and dotted parameters such as algo.lr. A
run can be named by any unique part of its name.
The table rounds numbers; csv and json have field names and all digits; json has all parameters.
AUC is normalised by the range of each run's own curve: it shows how early a run learns, not how well. A run
evaluated fewer than three times has none; a flat curve has 0.5.
"""

_FOR_COLUMNS_ONLY = ("cell", "directory", "host", "pid", "created")
_FIELDS = tuple(item.name for item in fields(RunRow) if item.name not in _FOR_COLUMNS_ONLY)
_IN_TABLE = (
    "run_id",
    "study",
    "algorithm",
    "seed",
    "status",
    "env_steps",
    "final_reward",
    "auc",
    "cpu_seconds",
    "kwh",
)
"""Columns of the table, unless others are chosen. The run's name begins with its environment."""
_MAX_SETTINGS = 4
"""Most varied settings that have a column of the table."""
# The run's name already contains algorithm and seed; the algorithm is dropped last.
_SPARE_ON_TERMINAL = ("seed", "kwh", "cpu_seconds", "env_steps", "auc", "study", "algorithm")
_HEADINGS = {
    "env_steps": "env steps",
    "final_reward": "final reward",
    "auc": AUC_HEADING,
    "cpu_seconds": "CPU s",
    "kwh": "kWh",
    "kg_co2": CO2_HEADING,
    "duration_s": "seconds",
    "run_id": "run",
}
"""Column headings that differ from the field's name, as in the results table that ends a run."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the filters and the format."""
    parser.add_argument("--study", help="only runs of this study")
    parser.add_argument("--env", help="only runs on this environment")
    parser.add_argument("--algo", help="only runs of this algorithm")
    parser.add_argument("--seed", help="only these seeds: 7, 0,1,2 or 0..49")
    parser.add_argument("--status", help="only runs with this status: " + ", ".join(STATUSES))
    add_where_argument(parser)
    parser.add_argument(
        "--sort", default="", metavar="FIELDS", help="fields to sort by, such as 'final_reward desc, seed'"
    )
    parser.add_argument(
        "--columns", metavar="NAMES", help="fields and parameters to show, such as run_id,algo.lr"
    )
    add_format_argument(parser, ("table", "json", "csv"))
    add_store_argument(parser)


def execute(arguments: argparse.Namespace) -> int:
    """Print the runs that pass the filters."""
    from headway_launch.studies.run_filter import filter_runs
    from headway_launch.studies.runs import print_left_out

    index = RunIndex(existing_store(arguments.store))
    everything = index.rows()
    for folder, problem in index.notices.items():
        print_left_out(folder, problem)
    _require_known("study", arguments.study, {row.study for row in everything})
    _require_known("env", arguments.env, {row.environment for row in everything})
    _require_known("algo", arguments.algo, {row.algorithm for row in everything})
    status = arguments.status.upper() if arguments.status else None
    _require_known("status", status, set(STATUSES))
    seeds = parse_seeds(arguments.seed, "--seed") if arguments.seed else None
    if seeds is not None and everything and not {row.seed for row in everything} & set(seeds):
        raise HeadwayError(f"--seed {arguments.seed}: no run has such a seed")
    rows = [
        row
        for row in filter_runs(everything, arguments.where, arguments.sort)
        if arguments.study in (None, row.study)
        and arguments.env in (None, row.environment)
        and arguments.algo in (None, row.algorithm)
        and status in (None, row.status)
        and (seeds is None or row.seed in seeds)
    ]
    if arguments.format == "json":
        _print_json(rows, arguments.columns)
    elif arguments.format == "csv":
        _print_csv(rows, arguments.columns)
    else:
        _print_table(rows, arguments.columns)
    return 0


def _require_known(option: str, value: str | None, known: set[str]) -> None:
    if value is not None and value not in known:
        raise HeadwayError(f"--{option} {value}: no run has this value; {suggestion(value, known)}")


def _print_json(rows: Sequence[RunRow], columns: str | None) -> None:
    import json

    from headway_launch.studies.run_filter import parameters_of

    if columns is None:
        listed = [{**asdict(row), "parameters": parameters_of(row)} for row in rows]
    else:
        names, values, _ = _table(rows, columns, ())
        listed = [dict(zip(names, own, strict=True)) for own in values]
    print(json.dumps(listed, indent=1))


def _print_csv(rows: Sequence[RunRow], columns: str | None) -> None:
    import csv

    names, values, _ = _table(rows, columns, _FIELDS)
    writer = csv.writer(sys.stdout, lineterminator="\n")
    writer.writerow(names)
    writer.writerows(values)


def _print_table(rows: Sequence[RunRow], columns: str | None) -> None:
    names, values, settings = _table(rows, columns, _IN_TABLE)
    if columns:
        print_table(_headings(names), values, whole=_headings(("run_id", "status")))
        return
    shown, further = settings[:_MAX_SETTINGS], settings[_MAX_SETTINGS:]
    spare = (*_SPARE_ON_TERMINAL[:-1], *shown, _SPARE_ON_TERMINAL[-1])
    rest = [name for name in _FIELDS if name not in names and any(getattr(row, name) for row in rows)]
    rest += further
    kept = [place for place, name in enumerate(names) if name not in rest]
    fields = {_HEADINGS.get(name, name): name for name in names}

    def note(omitted: Sequence[str]) -> str:
        left_out = [*(fields[heading] for heading in omitted), *rest]
        hint = "(choose with --columns; --format csv has all)"
        return f"columns left out: {', '.join(left_out)} {hint}" if left_out else ""

    print_table(
        [_HEADINGS.get(names[place], names[place]) for place in kept],
        [[own[place] for place in kept] for own in values],
        whole=_headings(("run_id", "status")),
        spare=_headings(spare),
        note=note,
    )


def _table(
    rows: Sequence[RunRow], columns: str | None, fields: Sequence[str]
) -> tuple[list[str], list[list[Value]], list[str]]:
    """Return the names of the columns, the values of each run, and the names of varied settings."""
    from headway.store.cell_names import varied_settings
    from headway_launch.studies.run_filter import as_number, column_names, parameters_of

    if columns is not None:
        names = column_names(rows, columns)
        of_run = [parameters_of(row) if any("." in name for name in names) else {} for row in rows]
        return names, [_values(row, names, own) for row, own in zip(rows, of_run, strict=True)], []
    varied, settings = varied_settings(rows)
    own = {
        cell: {name: as_number(found[name]) for name in varied if name in found}
        for cell, found in settings.items()
    }
    after = fields.index("seed")
    names = [*fields[:after], *varied, *fields[after:]]
    return names, [_values(row, names, own.get(row.cell, {})) for row in rows], varied


def _headings(fields: Sequence[str]) -> list[str]:
    return [_HEADINGS.get(name, name) for name in fields]


def _values(row: RunRow, names: Sequence[str], parameters: Mapping[str, Value]) -> list[Value]:
    return [parameters.get(name) if "." in name else getattr(row, name) for name in names]
