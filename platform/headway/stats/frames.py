"""The statistics from pandas frames to pandas frames.

A frame of scores has a row a run: `controller` (what is compared: an algorithm with its settings), `task`
(the environment) and `score`. A frame of curves has a row a point: `controller`, `task`, `run_id`,
`env_steps` and `value`. Controllers stay in the order in which they first come.
"""

from collections.abc import Mapping, Sequence
from itertools import permutations

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray

from headway.stats.curves import auc, final_reward, value_range
from headway.stats.intervals import mean_and_half_width
from headway.stats.samples import mean_std
from headway.stats.scores import (
    Band,
    normalised,
    performance_profile,
    probability_of_improvement,
    sample_efficiency,
    stratified_bootstrap_interval,
)

_PROFILE_POINTS = 101
_COSTS = ("kwh", "cpu_kwh", "gpu_kwh", "ram_kwh", "kg_co2", "cpu_seconds")


def curve_figures(curves: pd.DataFrame) -> pd.DataFrame:
    """Of each run, by `run_id`: `controller`, `task`, `final_reward`, `auc_own` (normalised by the run's own
    range, as published; NaN of fewer points than `FEWEST_POINTS`) and `auc_study` (by the range of all curves
    of the task, for ranking; 0.5 where that is a single value). Raises ValueError for a curve whose
    steps do not increase."""
    rows = []
    for task, of_task in curves.groupby("task", sort=False):
        low, high = value_range([of_task["value"].to_numpy()])
        for run_id, curve in of_task.groupby("run_id", sort=False):
            steps, values = curve["env_steps"].to_numpy(), curve["value"].to_numpy()
            rows.append(
                {
                    "run_id": run_id,
                    "controller": curve["controller"].iloc[0],
                    "task": task,
                    "final_reward": final_reward(steps, values),
                    "auc_own": auc(steps, values),
                    "auc_study": auc(steps, values, low, high) if low < high else 0.5,
                }
            )
    columns = ["run_id", "controller", "task", "final_reward", "auc_own", "auc_study"]
    return pd.DataFrame(rows, columns=columns).set_index("run_id")


def mean_curves(curves: pd.DataFrame) -> pd.DataFrame:
    """The learning curves: at the steps that all runs of a controller on a task have, their `mean`, the ends
    `low` and `high` of its 95% interval by Student's t (NaN for one run), and how many `runs`."""
    frames = []
    for (task, controller), of_cell in curves.groupby(["task", "controller"], sort=False):
        table = _table(of_cell)
        values = table.to_numpy().T
        mean, half = values.mean(axis=0), np.full(len(table), np.nan)
        if len(values) > 1:
            mean, half = mean_and_half_width(values)
        points = {"env_steps": table.index, "mean": mean, "low": mean - half, "high": mean + half}
        labels = {"task": task, "controller": controller, "runs": len(values)}
        frames.append(pd.DataFrame({**labels, **points}))
    columns = ["task", "controller", "runs", "env_steps", "mean", "low", "high"]
    return pd.concat(frames, ignore_index=True) if frames else pd.DataFrame(columns=columns)


def on_common_steps(curves: pd.DataFrame) -> pd.DataFrame:
    """Curves for `mean_curves` of runs whose points lie at different steps, as where episodes end at other
    updates in each: within the span of all runs of a controller on a task, each has a point at every step of
    any of them, on the straight line between its own. Runs without a common span stay as they are."""
    frames = [curves.iloc[:0]]
    for _, of_cell in curves.groupby(["task", "controller"], sort=False):
        runs = [run.sort_values("env_steps") for _, run in of_cell.groupby("run_id", sort=False)]
        first = max(run["env_steps"].iloc[0] for run in runs)
        last = min(run["env_steps"].iloc[-1] for run in runs)
        steps = np.unique(of_cell["env_steps"])
        steps = steps[(first <= steps) & (steps <= last)]
        for run in runs if len(steps) else ():
            values = np.interp(steps, run["env_steps"], run["value"])
            frames.append(pd.DataFrame({**run.iloc[0], "env_steps": steps, "value": values}))
        if not len(steps):
            frames.append(of_cell)
    return pd.concat(frames, ignore_index=True)


def summary(scores: pd.DataFrame) -> pd.DataFrame:
    """Of each controller, over its runs on all tasks: `runs`, `mean`, `std` (ddof = 1; NaN for one run) and
    the interquartile mean `iqm` with its 95% interval `iqm_low`, `iqm_high` by the stratified bootstrap.

    The interval is NaN where a task has but one run: drawn again and again it would look certain."""
    rows = []
    for controller, of_controller in scores.groupby("controller", sort=False):
        figures = mean_std(of_controller["score"].to_numpy())
        tasks = list(_by_task(of_controller).values())
        interval, known = stratified_bootstrap_interval(tasks), _several_runs(tasks)
        rows.append(
            {
                "controller": controller,
                "runs": figures.count,
                "mean": figures.mean,
                "std": figures.std,
                "iqm": interval.estimate,
                "iqm_low": interval.low if known else np.nan,
                "iqm_high": interval.high if known else np.nan,
            }
        )
    columns = ["controller", "runs", "mean", "std", "iqm", "iqm_low", "iqm_high"]
    return pd.DataFrame(rows, columns=columns).set_index("controller")


def improvements(scores: pd.DataFrame) -> pd.DataFrame:
    """Of each ordered pair of controllers, over the tasks that both have: the `probability` that a run of `a`
    scores above a run of `b`, with the ends `low` and `high` of its 95% interval (NaN where a task has but
    one run of each); pairs without a common task are left out."""
    by_controller = {
        str(controller): _by_task(of_controller)
        for controller, of_controller in scores.groupby("controller", sort=False)
    }
    rows = []
    for a, b in permutations(by_controller, 2):
        common = [task for task in by_controller[a] if task in by_controller[b]]
        if not common:
            continue
        left, right = ([by_controller[name][task] for task in common] for name in (a, b))
        found = probability_of_improvement(left, right)
        known = all(len(x) > 1 or len(y) > 1 for x, y in zip(left, right, strict=True))
        low, high = (found.low, found.high) if known else (np.nan, np.nan)
        rows.append({"a": a, "b": b, "probability": found.estimate, "low": low, "high": high})
    return pd.DataFrame(rows, columns=["a", "b", "probability", "low", "high"])


def profiles(scores: pd.DataFrame, thresholds: ArrayLike | None = None) -> pd.DataFrame:
    """The performance profile of each controller: at each `threshold` (default: evenly over all scores) the
    `share` of runs above it, with the ends `low` and `high` of its 95% interval (NaN where a task has but
    one run)."""
    points = np.asarray(even_thresholds(scores) if thresholds is None else thresholds, np.float64)
    frames = []
    for controller, of_controller in scores.groupby("controller", sort=False):
        tasks = list(_by_task(of_controller).values())
        band = _honest(performance_profile(tasks, points), tasks)
        frames.append(_banded(str(controller), "threshold", points, band, "share"))
    columns = ["controller", "threshold", "share", "low", "high"]
    return pd.concat(frames, ignore_index=True) if frames else pd.DataFrame(columns=columns)


def even_thresholds(scores: pd.DataFrame) -> NDArray[np.float64]:
    """Thresholds for `profiles`: even steps over the range of some scores, and a little beyond."""
    least, most = scores["score"].min(), scores["score"].max()
    margin = 0.02 * (most - least) or 1.0
    return np.linspace(least - margin, most + margin, _PROFILE_POINTS)


def efficiency(curves: pd.DataFrame) -> pd.DataFrame:
    """The sample-efficiency curve of each controller: at the `env_steps` that all its runs on all its tasks
    have, the interquartile mean `iqm` with the ends `low` and `high` of its 95% interval (NaN where a task
    has but one run). A controller whose runs share no steps is left out."""
    frames = []
    for controller, of_controller in curves.groupby("controller", sort=False):
        tables = [_table(of_task) for _, of_task in of_controller.groupby("task", sort=False)]
        steps = tables[0].index
        for table in tables[1:]:
            steps = steps.intersection(table.index)
        if len(steps):
            values = [table.loc[steps].to_numpy().T for table in tables]
            band = _honest(sample_efficiency(values), values)
            frames.append(_banded(str(controller), "env_steps", steps.to_numpy(), band, "iqm"))
    columns = ["controller", "env_steps", "iqm", "low", "high"]
    return pd.concat(frames, ignore_index=True) if frames else pd.DataFrame(columns=columns)


def costs(summaries: pd.DataFrame) -> pd.DataFrame:
    """What a run cost, of each task and controller (the index), from `RunSelection.summaries`: of `kwh`, its
    parts, `kg_co2` and `cpu_seconds` the mean and, `..._std`, the deviation over runs (ddof = 1; NaN for
    one), and how many `runs`. Only of runs whose energy was measured; what is not known is NaN, never 0, and
    the CO2 is known where that of every such run is."""
    whole = summaries.reindex(columns=["task", "controller", *_COSTS])
    measured = whole[whole["kwh"].notna()].astype(dict.fromkeys(_COSTS, np.float64))
    grouped = measured.groupby(["task", "controller"], sort=False)
    deviations = grouped[list(_COSTS)].std(ddof=1).add_suffix("_std")
    found = grouped[list(_COSTS)].mean().join(deviations).assign(runs=grouped.size())
    complete = grouped["kg_co2"].count() == found["runs"]
    return found.assign(**{name: found[name].where(complete) for name in ("kg_co2", "kg_co2_std")})


def normalised_by_rules(
    frame: pd.DataFrame, column: str, rules: Mapping[str, tuple[float, float]]
) -> pd.DataFrame:
    """`frame`, which has `task`, with its `column` on the scale of the task's rules (random play, best rule):
    0 = random, 1 = best rule. Raises ValueError for a task without them, or whose best is no better."""
    missing = sorted(set(frame["task"]) - set(rules))
    if missing:
        raise ValueError(f"no random play and best rule are known of {', '.join(missing)}")
    scaled = [
        of_task.assign(**{column: normalised(of_task[column].to_numpy(), *rules[str(task)])})
        for task, of_task in frame.groupby("task", sort=False)
    ]
    return pd.concat(scaled).loc[frame.index]


def _by_task(scores: pd.DataFrame) -> dict[str, NDArray[np.float64]]:
    return {
        str(task): of_task["score"].to_numpy(np.float64)
        for task, of_task in scores.groupby("task", sort=False)
    }


def _table(curves: pd.DataFrame) -> pd.DataFrame:
    """The steps that all runs have (index, in order) by runs."""
    return curves.pivot_table(index="env_steps", columns="run_id", values="value").dropna().sort_index()


def _several_runs(tasks: Sequence[NDArray[np.float64]]) -> bool:
    """Whether every task, with runs along its first axis, has more than one."""
    return all(len(task) > 1 for task in tasks)


def _honest(band: Band, tasks: Sequence[NDArray[np.float64]]) -> Band:
    """A band without ends where they would be those of single runs drawn again and again."""
    if _several_runs(tasks):
        return band
    return Band(band.estimate, np.full_like(band.low, np.nan), np.full_like(band.high, np.nan))


def _banded(
    controller: str, axis: str, points: Sequence[float] | NDArray[np.float64], band: Band, name: str
) -> pd.DataFrame:
    columns = {axis: points, name: band.estimate, "low": band.low, "high": band.high}
    return pd.DataFrame({"controller": controller, **columns})
