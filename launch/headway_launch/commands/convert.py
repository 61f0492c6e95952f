"""`headway convert`: write a study's logs as CSV files or for TensorBoard, Weights & Biases or marl-eval."""

import argparse
import json
import os
import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from datetime import datetime
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from headway.contracts.errors import HeadwayError
from headway.wording import counted
from headway_launch.commands.arguments import add_store_argument, add_where_argument, existing_store
from headway_launch.console.output_files import write_error
from headway_launch.console.progress_display import CountedProgress

if TYPE_CHECKING:
    import pandas as pd

    from headway.store.index import RunRow
    from headway.store.query import RunSelection

EXAMPLES = """\
examples:
  headway convert bus --to csv
  headway convert bus --to tensorboard && tensorboard --logdir tensorboard-bus
  headway convert bus --to wandb && wandb sync wandb-bus/wandb/offline-run-*
  headway convert bus --to marl-eval
  headway convert bus --to csv --where 'algorithm="mappo"' --output lab/mappo

Reads the logs of the newest finished run of each cell and seed; nothing is sent anywhere. csv: one file per
table, columns.csv with meanings and units, and each run's configuration; tensorboard: a folder of event files
per run; wandb: an offline run per run, in the project STUDY. In both, the steps are environment steps.
marl-eval: metrics.json with the evaluation episodes, as that package reads it: metrics that all runs have,
with spaces in place of underscores, which it would take apart; absolute_metrics are the episodes that
`headway compare STUDY --best --keep` stored of the best policies or, if a run has none, those of the last
evaluation.
"""
_MEANINGS = {
    "run_id": "name of the run",
    "study": "name of the study",
    "cell": "key of the cell: an environment and an algorithm with their settings",
    "label": "name of the cell among those of its study",
    "task": "environment, with the arguments in which cells differ",
    "controller": "algorithm, with the settings in which cells differ",
    "rule": "name of the rule",
    "seed": "training seed",
    "status": "RUNNING, FINISHED, FAILED or KILLED",
    "iteration": "number of the iteration",
    "env_steps": "environment steps of the seed by the end of the iteration",
    "wall_s": "time since the start of the run, s",
    "copy": "number of the environment copy that played the episode",
    "mode": "how the policy acted: greedy or sampled",
    "final": "1 in the last evaluation, 0 in others",
    "episode_seed": "seed of the episode, by which episodes of policies and rules are paired",
    "time": "seconds since 1970, s",
    "time/collect_s": "duration of the iteration's rollouts, s",
    "time/learn_s": "duration of the iteration's update, s",
    "started": "UTC, ISO 8601",
    "duration_s": "wall time over all sessions, s",
    "steps_per_second": "environment steps per second of wall time, 1/s",
    "cpu_seconds": "CPU time, s",
    "final_reward": "mean return of the evaluations in the last 20% of the steps",
    "auc": "area under the run's curve, normalised by its own range",
    "kwh": "energy, kWh",
    "cpu_kwh": "energy of the CPU, kWh",
    "gpu_kwh": "energy of the GPU, kWh",
    "ram_kwh": "energy of the memory, kWh",
    "kg_co2": "CO2 equivalent of the energy, kg",
}
"""Meanings of columns that all environments have, with their units."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the study, the target and the folder."""
    parser.add_argument("study", metavar="STUDY", help="name of the study, as in `headway runs`")
    parser.add_argument("--to", choices=_WRITERS, required=True, help="what to write")
    parser.add_argument("-o", "--output", metavar="DIR", help="new folder to write (default: TO-STUDY)")
    add_where_argument(parser)
    add_store_argument(parser)


def execute(arguments: argparse.Namespace) -> int:
    """Write the logs and print the folder."""
    from headway_launch.studies.runs import finished_runs

    root = existing_store(arguments.store)
    output = Path(arguments.output or f"{arguments.to}-{arguments.study}")
    runs = finished_runs(root, arguments.study, arguments.where)
    with _new_folder(output) as folder:
        _WRITERS[arguments.to](runs, folder)
    print(output)
    return 0


@contextmanager
def _new_folder(output: Path) -> Iterator[Path]:
    """Yield a temporary folder that becomes `output` at the end.

    Raises HeadwayError if `output` is in use or cannot be written.
    """
    if output.exists() and not (output.is_dir() and not any(output.iterdir())):
        raise HeadwayError(f"--output: {output} exists; remove it or name a new folder")
    try:
        with tempfile.TemporaryDirectory(dir=output.parent, prefix=f".{output.name}.") as beside:
            folder = Path(beside, "new")
            folder.mkdir()
            yield folder
            folder.rename(output)
    except OSError as error:
        raise write_error("--output", output, error) from error


def _write_csv(runs: "RunSelection", folder: Path) -> None:
    import pandas as pd

    tables: Mapping[str, Callable[[], pd.DataFrame]] = {
        "runs": runs.summaries,
        "curves": runs.curves,
        "episodes": runs.episodes,
        "evaluations": runs.evaluations,
        "rules": runs.rules,
        "energy": runs.energy,
    }
    meanings, columns = _metric_meanings(runs), []
    with CountedProgress("tables written", len(tables)) as progress:
        for name, read in tables.items():
            if len(table := read()):
                table.to_csv(folder / f"{name}.csv", index=False)
                columns += [(name, column, _meaning(column, meanings)) for column in table.columns]
            progress.add()
    (folder / "configs").mkdir()
    for run_id, text in runs.configurations().items():
        (folder / "configs" / f"{run_id}.yaml").write_text(text, encoding="utf-8")
    listed = pd.DataFrame(columns, columns=["table", "column", "meaning"])
    listed.to_csv(folder / "columns.csv", index=False)


def _write_tensorboard(runs: "RunSelection", folder: Path) -> None:
    # One event per iteration: `tensorboard.summary.Writer` writes one per value, in nine times the time.
    files = _optional("tensorboard.summary.writer.event_file_writer")
    events = _optional("tensorboard.compat.proto.event_pb2")
    summaries = _optional("tensorboard.compat.proto.summary_pb2")
    meanings = _metric_meanings(runs)
    for row, curve in _curves(runs):
        started, described = datetime.fromisoformat(row.started).timestamp(), set[str]()
        writer = files.EventFileWriter(str(folder / row.run_id))
        for step, wall_s, metrics in _points(curve):
            summary = summaries.Summary()
            for name, value in metrics.items():
                added = summary.value.add(tag=name, simple_value=value)
                if name not in described:
                    added.metadata.summary_description = _meaning(name, meanings)
                    described.add(name)
            writer.add_event(events.Event(wall_time=started + wall_s, step=step, summary=summary))
        writer.close()


def _write_wandb(runs: "RunSelection", folder: Path) -> None:
    from headway.store.run_folder import read_summary
    from headway_launch.studies.runs import configuration

    os.environ["WANDB_ERROR_REPORTING"] = "false"  # nothing is sent anywhere
    wandb = _optional("wandb")
    quiet = {"silent": True, "console": "off", "disable_git": True, "save_code": False}
    settings = wandb.Settings(mode="offline", x_disable_meta=True, x_disable_stats=True, **quiet)
    for row, curve in _curves(runs):
        identity = {"project": row.study, "id": row.run_id, "name": row.run_id, "group": row.cell}
        config = dict(configuration(row.directory))
        with wandb.init(**identity, config=config, dir=str(folder), settings=settings) as run:
            run.define_metric("*", step_metric="env_steps")
            for step, wall_s, metrics in _points(curve):
                run.log({"env_steps": step, "wall_s": wall_s, **metrics})
            run.summary.update(read_summary(Path(row.directory)))
    wandb.teardown()  # its service may write the end of the files after the runs have finished


def _write_marl_eval(runs: "RunSelection", folder: Path) -> None:
    """Write environment -> task -> algorithm -> seed -> evaluation -> metric -> values of the episodes.

    Raises HeadwayError for algorithms of an environment with different tasks, seeds or numbers of
    evaluations, which marl-eval cannot read.
    """
    from headway.events import LABELS
    from headway.store.cell_names import labelled_cells
    from headway.store.query import LABELS as RUN_LABELS
    from headway_launch.studies.kept_episodes import kept_episodes
    from headway_launch.studies.runs import common_mode, configuration

    mode = common_mode(runs)
    played = runs.evaluations(mode=mode).sort_values(["env_steps", "episode_seed"])
    known = {*RUN_LABELS, *LABELS}
    metrics = [str(name) for name in played if name not in known and played[name].notna().all()]

    def values(rows: "pd.DataFrame") -> dict[str, list[float]]:
        return {name.replace("_", " ").lower(): rows[name].astype(float).tolist() for name in metrics}

    absolute: dict[str, pd.DataFrame] = {}
    for members in labelled_cells(runs.rows, runs.beside).values():
        absolute |= kept_episodes(members, mode, metrics)[0]
    if len(absolute) < len(runs.rows):
        absolute = {
            row.run_id: played[(played["run_id"] == row.run_id) & (played["final"] == 1)] for row in runs.rows
        }
    tree: dict[str, dict[str, dict[str, dict[str, Any]]]] = {}
    for row in runs.rows:
        name, of_run = runs.names[row.cell], played[played["run_id"] == row.run_id]
        # The last evaluation begins with the episodes of the others.
        episodes = int(configuration(row.directory)["evaluation"]["episodes"])
        of_curve = of_run[of_run["episode_seed"] < episodes]
        steps = {
            f"step_{place}": {"step_count": int(str(step)), **values(rows)}
            for place, (step, rows) in enumerate(of_curve.groupby("env_steps"))
        }
        of_task = tree.setdefault(row.environment.lower(), {}).setdefault(name.task.lower(), {})
        seeds = of_task.setdefault(name.controller, {})
        seeds[f"seed_{row.seed}"] = {**steps, "absolute_metrics": values(absolute[row.run_id])}
    for tasks in tree.values():
        _require_alike(tasks)
    (folder / "metrics.json").write_text(json.dumps(tree), encoding="utf-8")


def _require_alike(tasks: Mapping[str, Mapping[str, Mapping[str, Any]]]) -> None:
    """Raise HeadwayError unless all tasks have the same algorithms with equal seeds and numbers of points."""
    names = sorted({name for algorithms in tasks.values() for name in algorithms})
    points = {
        f"{name} on {task}": {seed: len(whole) - 1 for seed, whole in algorithms.get(name, {}).items()}
        for task, algorithms in tasks.items()
        for name in names
    }
    (first, expected), *others = points.items()
    for cell, found in others:
        if sorted(found.items()) != sorted(expected.items()):
            raise HeadwayError(
                "--to marl-eval: it needs equal seeds and numbers of evaluations everywhere, but there are "
                f"{_listed(expected)} of {first} and {_listed(found)} of {cell}; choose runs with --where"
            )


def _listed(points: Mapping[str, int]) -> str:
    shown = [f"{seed} ({counted(number, 'evaluation')})" for seed, number in sorted(points.items())]
    return ", ".join(shown) or "none"


_WRITERS: Mapping[str, Callable[["RunSelection", Path], None]] = {
    "csv": _write_csv,
    "tensorboard": _write_tensorboard,
    "wandb": _write_wandb,
    "marl-eval": _write_marl_eval,
}
"""(runs, new folder) -> None, by the value of --to."""


def _optional(module: str) -> Any:  # noqa: ANN401 - a module
    """Return a module of the extra with its package's name. Raises HeadwayError if it is not installed."""
    try:
        return import_module(module)
    except ImportError as error:
        extra = module.partition(".")[0]
        line = f'--to {extra} needs the package {extra}; install it with pip install "headway[{extra}]"'
        raise HeadwayError(line) from error


def _curves(runs: "RunSelection") -> Iterator[tuple["RunRow", "pd.DataFrame"]]:
    """Yield each run with its curve, and show progress."""
    with CountedProgress("runs converted", len(runs.rows)) as progress:
        for row in runs.rows:
            yield row, replace(runs, rows=(row,)).curves()
            progress.add()


def _points(curve: "pd.DataFrame") -> Iterator[tuple[int, float, dict[str, float]]]:
    """Yield the environment steps, the seconds since the start and the metrics of each iteration."""
    names = [name for name in curve.columns if "/" in name]
    for point in curve.to_dict("records"):
        metrics = {name: float(point[name]) for name in names if point[name] == point[name]}  # no NaN
        yield int(point["env_steps"]), float(point.get("wall_s", 0.0)), metrics


def _metric_meanings(runs: "RunSelection") -> dict[str, str]:
    """Return the meaning of each episode metric of the runs' environments."""
    from headway_launch.commands.listing import COMMON_METRICS
    from headway_launch.studies.runs import metric_descriptions

    return {**COMMON_METRICS, **metric_descriptions(runs)}


def _meaning(column: str, metrics: Mapping[str, str]) -> str:
    group, _, name = column.rpartition("/")
    of_episodes = not group or group == "training" or group.startswith("evaluation_")
    return _MEANINGS.get(column) or (metrics.get(name, "") if of_episodes else "")
