"""Sections on provenance: the runs, their command lines, configurations and versions."""

import shlex
from collections.abc import Mapping
from pathlib import Path
from textwrap import wrap
from typing import Any

import pandas as pd

from headway.contracts.errors import HeadwayError
from headway.stats.curves import FEWEST_POINTS
from headway.store.index import RunRow
from headway_launch.console.number_formats import MISSING, formatted, scale_of
from headway_launch.report.elements import Listing, Part, Section, Table
from headway_launch.report.reproduction_line import reproducing_line
from headway_launch.report.study_data import StudyData
from headway_launch.runner.recorder import TRACEBACK
from headway_launch.studies.runs import configuration

_SHOWN = ("final_reward", "auc", "env_steps", "kwh", "cpu_seconds", "steps_per_second", "duration_s")
_METRICS = (*_SHOWN, "kg_co2")
_COMMAND_WIDTH = 100
_MOST_VALUES = 3
"""Maximum number of values of a tag that are listed; if there are more, only their number is given."""


def runs_section(data: StudyData) -> Section:
    """Return the section with every run of the study, including excluded ones."""
    included = {row.run_id for row in data.runs.rows}
    every = data.all_runs.summaries().set_index("run_id")
    for name in _METRICS:
        every[name] = pd.to_numeric(every[name]) if name in every else float("nan")
    every["duration_s"] = every["duration_s"].where(every["status"] != "RUNNING")  # up to a checkpoint
    largest = every["kwh"].max()
    unit, factor = scale_of(float(largest) if largest > 0 else 1.0, "kWh")
    shown = every.assign(kwh=every["kwh"] * factor)[list(_SHOWN)].to_dict("index")
    rows = [
        [
            run.run_id,
            run.status if run.status != "FINISHED" or run.run_id in included else "FINISHED, excluded",
            *(formatted(float(value)) for value in shown[run.run_id].values()),
        ]
        for run in data.all_runs.rows
    ]
    lines = [_line(run) for run in data.all_runs.rows]
    exact = every[["label", "seed", "status", "started", *_METRICS]]
    exact = exact.assign(included=[run in included for run in exact.index], reproduce=lines)
    body: list[Part] = []
    if data.excluded:
        body.append(f"Excluded from all results on this page: {'; '.join(data.excluded)}.")
    body += [f"{row.run_id} failed: {_reason(row)}" for row in data.all_runs.rows if row.status == "FAILED"]
    body.append(
        Table(
            "runs",
            "Every run of the study. The AUC is normalised by the run's own range; a run evaluated fewer "
            f"than {FEWEST_POINTS} times has none.",
            ["run", "status", "final reward", "AUC", "env steps", unit, "CPU s", "steps/s", "wall s"],
            rows,
            exact.reset_index(),
            words=frozenset({0, 1}),
            per_run=True,
        )
    )
    body.append(Listing("The command line of each run", "\n".join(lines), "commands.txt"))
    return Section("runs", "Runs", body)


def _determinism_exception(data: StudyData) -> str:
    """Return the end of the sentence on bitwise reproduction, which names its exceptions."""
    cells = [configuration(members[0].directory) for members in data.cells.values()]
    if any(cell["algo"].get("application") == "arrival" for cell in cells):
        return ", except for algorithms that apply gradients in order of arrival (`algo.application`)."
    return "."


def provenance_section(data: StudyData) -> Section:
    """Return the section with configurations, one command line per cell, versions and hardware."""
    import yaml

    body: list[Part] = [
        "Each command line below repeats the training of one cell's seeds. It sets every key that differs "
        "from this version's defaults, except keys that do not affect results: where runs are stored "
        "(`store`) and how they are distributed over processes (`backend`, apart from `backend.stack`). "
        "`evaluation.rules` appears only if some rules of the environment were not run. For an environment "
        "in a file it names the configuration in `configs/`, a folder of this report. The full "
        "configuration, with every default spelt out but without `store.root`, comes after it. On a CPU, the "
        "same configuration and seed reproduce the curve bit for bit with the versions listed here"
        + _determinism_exception(data)
    ]
    for (task, controller), members in data.cells.items():
        first = configuration(members[0].directory)
        seeds = ",".join(str(seed) for seed in sorted({row.seed for row in members}))
        title = controller if len(data.tasks) == 1 else f"{controller}, {task}"
        body.append(
            Listing(
                f"{title}: command line", _wrapped(_line_of(first, seeds, members[0].cell)), unfolded=True
            )
        )
        stored = {key: value for key, value in first.get("store", {}).items() if key != "root"}
        whole = {**first, "seed": [row.seed for row in members], "store": stored}
        text = yaml.safe_dump(whole, sort_keys=False)
        body.append(Listing(f"{title}: configuration", text, _file(members[0].cell)))
    made = data.runs.provenance()
    tags = [name for name in made.columns if "." in name]
    rows = [[str(name), _values(made[name])] for name in tags]
    body.append(
        Table(
            "versions",
            "Versions and hardware of the runs.",
            ["item", "values over the runs on this page"],
            rows,
            made[["run_id", *tags]],
            words=frozenset({0, 1}),
        )
    )
    dirty = "git.dirty" in made and (made["git.dirty"] == "true").any()
    if dirty:
        body.append("Some runs used uncommitted changes to the code (`git.dirty`).")
    return Section("provenance", "Provenance", body)


def _line(run: RunRow) -> str:
    try:
        return _line_of(configuration(run.directory), str(run.seed), run.cell)
    except HeadwayError as error:  # incomplete run folder
        return f"# {run.run_id}: {error}"


def _file(cell: str) -> str:
    """Return the path, in the report's folder, of a cell's configuration."""
    return f"configs/{cell}.yaml"


def _line_of(mapping: Mapping[str, Any], seeds: str, cell: str) -> str:
    try:
        return reproducing_line(mapping, seeds, _file(cell))
    except HeadwayError as error:
        return f"# cannot be repeated with this version and the installed packages: {error}"


def _wrapped(line: str) -> str:
    """Continue a command line over several lines, as a shell reads it; a comment stays as it is."""
    if line.startswith("#"):
        return line
    words = (shlex.quote(word).replace(" ", "\0") for word in shlex.split(line))
    lines = wrap(" ".join(words), _COMMAND_WIDTH, break_long_words=False, break_on_hyphens=False)
    return " \\\n    ".join(lines).replace("\0", " ")


def _reason(run: RunRow) -> str:
    """Return the last line of a failed run's traceback, without backquotes, which would make it code."""
    path = Path(run.directory) / TRACEBACK
    try:
        lines = path.read_text(encoding="utf-8").strip().splitlines() if path.is_file() else []
    except (OSError, UnicodeDecodeError):
        return "no traceback stored"
    return lines[-1].replace("`", "'") if lines else "no traceback stored"


def _values(column: "pd.Series[Any]") -> str:
    values = [str(value) for value in column.dropna().unique()]
    absent = ", missing in some" if column.isna().any() and values else ""
    if len(values) > _MOST_VALUES:
        return f"{len(values)} different values{absent}"
    return (", ".join(values) or MISSING) + absent
