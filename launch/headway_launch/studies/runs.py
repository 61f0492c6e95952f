"""The finished runs of a study, one per seed, and their curves for plots."""

import shlex
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from headway.config.experiment import steps_per_iteration
from headway.config.schema import suggestion
from headway.contracts.errors import HeadwayError
from headway_launch.console.output import print_line, print_notice
from headway_launch.studies.run_filter import filter_runs

if TYPE_CHECKING:
    import pandas as pd

    from headway.store.index import RunRow
    from headway.store.query import RunSelection

_READ_OF_ALL = ("env", "evaluation", "energy")
"""Groups of a run's configuration that results are read from; the file ends with the last."""


def require_results(directory: Path) -> None:
    """Raise HeadwayError if the configuration, the curve or the evaluations of a finished run are damaged."""
    from headway.store.parquet_log import require_readable

    config = configuration(str(directory))
    if missing := [key for key in _READ_OF_ALL if not isinstance(config.get(key), Mapping)]:
        raise HeadwayError(
            f"{directory / 'config.yaml'} lacks {', '.join(missing)}: restore it, or remove this run's folder"
        )
    require_readable(directory)


def finished_runs(
    root: Path,
    study: str,
    where: Sequence[str] = (),
    require: Callable[[Path], object] = require_results,
) -> "RunSelection":
    """Return the newest finished run of each cell and seed of a study for which `where` holds, oldest first.

    Cells are named beside all of the study's, so that one has the same name before the others have finished.
    Prints how many runs are left out: unfinished, superseded by a newer run of the seed, or damaged.
    `require`: as in `included_runs`.

    Raises HeadwayError if there is no such study or no such run, and for an invalid condition.
    """
    from headway.store.query import RunSelection

    rows, included, excluded = included_runs(root, study, require)
    if excluded:
        print_line(f"headway: runs of {study} left out: {', '.join(excluded)}")
    return RunSelection(root, tuple(matching_runs(included, where)), beside=tuple(rows))


def matching_runs(included: Sequence["RunRow"], where: Sequence[str]) -> list["RunRow"]:
    """Return the runs for which `where` holds. Raises HeadwayError if it is invalid or holds for none."""
    if chosen := filter_runs(included, where):
        return chosen
    studies = ", ".join(dict.fromkeys(row.study for row in included))
    raise HeadwayError(f"--where: no finished run of {studies} matches; see headway runs --where")


def included_runs(
    root: Path, study: str, require: Callable[[Path], object] = require_results
) -> tuple[list["RunRow"], list["RunRow"], list[str]]:
    """Return (all runs of a study, those that results include, one phrase per reason for leaving runs out).

    `require` raises HeadwayError for the folder of a run with a damaged file; such a run is left out, with a
    line that says so, and an older one of its seed takes its place. Raises HeadwayError if there is no such
    study, and if no finished run is left.
    """
    from headway.store.index import RunIndex

    index = RunIndex(root)
    rows = index.rows(study)
    damaged = dict(index.notices)
    if not rows and not damaged:
        studies = sorted({row.study for row in index.rows()})
        raise HeadwayError(f"there is no study {study!r} in {root}; {suggestion(study, studies)}")
    finished = [row for row in rows if row.status == "FINISHED"]
    newest: dict[tuple[str, int], RunRow] = {}
    for row in reversed(finished):
        if (row.cell, row.seed) in newest:
            continue
        try:
            require(Path(row.directory))
            newest[row.cell, row.seed] = row
        except HeadwayError as error:
            damaged[Path(row.directory)] = str(error)
    for folder, problem in damaged.items():
        print_left_out(folder, problem)
    included = [row for row in finished if newest.get((row.cell, row.seed)) is row]
    others = Counter(row.status for row in rows if row.status != "FINISHED")
    kinds = ", ".join(f"{count} {status}" for status, count in sorted(others.items()))
    excluded = [f"{others.total()} not finished ({kinds})"] if others else []
    if others and not finished:
        raise HeadwayError(
            f"study {study!r} has no finished run ({kinds}); see headway runs --study {shlex.quote(study)}"
        )
    if not included:
        raise HeadwayError(f"every finished run of study {study!r} is damaged, as the lines above say")
    if repeats := sum(Path(row.directory) not in damaged for row in finished) - len(included):
        excluded.append(f"{repeats} superseded by a newer run of the same seed")
    if damaged:
        excluded.append(f"{len(damaged)} damaged")
    return rows, included, excluded


def print_left_out(folder: Path, problem: str) -> None:
    """Print that the run in `folder` is left out because of a damaged file."""
    print_notice(f"run {folder.name} is left out: {problem}")


def print_rules_left_out(problem: str) -> None:
    """Print that rules are left out because of a damaged file."""
    print_notice(f"rules are left out: {problem}")


def curve_column(metric: str) -> str:
    """Return the column that `--metric` names; a name without group is of `evaluation_greedy`."""
    return metric if "/" in metric else f"evaluation_greedy/{metric}"


def curves_of(runs: "RunSelection", metric: str) -> "pd.DataFrame":
    """Return the curves of a metric in the layout of `headway.stats.frames`, ready to be averaged over runs.

    Training curves are interpolated to common steps. Raises HeadwayError for a run without the metric, and
    for a cell whose runs share no step.
    """
    from headway.stats import frames

    curves = curve_points(runs, metric)
    have = set(curves["run_id"])
    for row in runs.rows:
        if row.run_id not in have:
            # Suggest only metrics of the same kind that all runs have.
            kind = "evaluation_" if metric.startswith("evaluation_") else ""
            in_all = runs.curves().groupby("run_id").count().gt(0).all()
            known = [name for name in in_all[in_all].index if "/" in name and name.startswith(kind)]
            raise HeadwayError(f"--metric: {row.run_id} has no {metric!r}; {suggestion(metric, known)}")
    if not metric.startswith("evaluation_"):
        curves = frames.on_common_steps(curves)
    for cell, points in curves.groupby("cell"):
        if points.groupby("env_steps")["run_id"].nunique().max() < points["run_id"].nunique():
            raise HeadwayError(f"the runs of {cell} share no step with a value of {metric!r}")
    return curves


def curve_points(runs: "RunSelection", metric: str) -> "pd.DataFrame":
    """Return the points of each run's curve of a metric, one per row; none for runs without the metric."""
    curves = runs.curves(["env_steps", metric])  # no error if no run has the metric
    kept = ["run_id", "cell", "label", "task", "controller", "seed", "env_steps"]
    # Controllers in the same order as in tables.
    ordered = curves.sort_values("controller", kind="stable", ignore_index=True)
    return (
        ordered.reindex(columns=[*kept, metric])
        .rename(columns={metric: "value"})
        .dropna(subset="value", ignore_index=True)
    )


def common_mode(runs: "RunSelection") -> str:
    """Return `greedy` if all runs were evaluated so, else `sampled`.

    Raises HeadwayError if the runs have no mode in common.
    """
    evaluated = [configuration(row.directory)["evaluation"]["modes"] for row in runs.rows]
    for mode in ("greedy", "sampled"):
        if all(mode in modes for modes in evaluated):
            return mode
    raise HeadwayError(
        f"the runs of {runs.rows[0].study} have no evaluation mode in common: some were evaluated only "
        "greedily, others only sampled; train them with a common mode, such as evaluation.modes=[greedy]"
    )


def metric_descriptions(runs: "RunSelection") -> dict[str, str]:
    """Return the description of each episode metric of the runs' environments."""
    from headway.registry import env_entries

    names = sorted({row.environment for row in runs.rows} & set(env_entries()))
    return {metric: said for name in names for metric, said in env_entries()[name].metrics.items()}


def rules_beside(runs: "RunSelection", metric: str) -> dict[str, dict[str, float]]:
    """Return the mean of an evaluation metric per task and rule, over the episodes of the curves' points.

    Empty for training metrics, which belong to other episodes and possibly to another reward.
    """
    group, _, column = metric.rpartition("/")
    if not group.startswith("evaluation_"):
        return {}
    played = runs.rules(print_rules_left_out)
    if column not in played:
        return {}
    # Rules may also have played the additional episodes of the last evaluation; these are left out.
    episodes = {
        runs.names[row.cell].task: int(configuration(row.directory)["evaluation"]["episodes"])
        for row in runs.rows
    }
    same = played[played["episode_seed"] < played["task"].map(episodes)].dropna(subset=[column])
    means: dict[str, dict[str, float]] = {}
    for task, rows in same.groupby("task", sort=False):
        by_rule = rows.groupby("rule", sort=False)[column].mean()
        means[str(task)] = {str(rule): float(value) for rule, value in by_rule.items()}
    return means


def rule_phases(runs: "RunSelection") -> dict[str, dict[str, tuple[str, int]]]:
    """Return the rule of `start.rule` and the environment steps in which it acts, per task and controller.

    Cells that do not start from a rule are left out, and so are runs whose configuration cannot be read.
    """
    phases: dict[str, dict[str, tuple[str, int]]] = {}
    for row in runs.rows:
        config: Mapping[str, Any] = {}
        with suppress(HeadwayError):
            config = configuration(row.directory)
        start, name = config.get("start") or {}, runs.names[row.cell]
        if start.get("rule") and name.controller not in phases.get(name.task, {}):
            iteration_steps = steps_per_iteration(config)
            steps = -(-start["env_steps"] // iteration_steps) * iteration_steps
            phases.setdefault(name.task, {})[name.controller] = start["rule"], steps
    return phases


@lru_cache(maxsize=4096)
def configuration(directory: str) -> Mapping[str, Any]:
    """Return the configuration in a run's folder, cached. Raises HeadwayError if it cannot be read."""
    from headway.store.run_configuration import read_configuration

    return read_configuration(Path(directory))
