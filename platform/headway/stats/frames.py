"""The statistics of `headway.stats` for pandas frames.

A frame of scores has one row per run: `controller` (what is compared: an algorithm with its settings), `task`
(the environment) and `final_reward`, as `curve_metrics` and `RunSelection.runs` return it. A frame of curves
has one row per point: `controller`, `task`, `run_id`, `env_steps` and `value`. Controllers keep the order of
their first row.
"""

from collections.abc import Mapping, Sequence
from itertools import combinations, permutations

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray

from headway.stats.curves import auc, final_reward, value_range
from headway.stats.intervals import mean_and_half_width
from headway.stats.pairs import PairRow, holm, pair_rows
from headway.stats.ranks import ranks, signed_rank_p_value
from headway.stats.samples import mean_std
from headway.stats.scores import (
    Band,
    interquartile_mean,
    normalised,
    performance_profile,
    probability_of_improvement,
    sample_efficiency,
)

_PROFILE_POINTS = 101
_COSTS = ("kwh", "cpu_kwh", "gpu_kwh", "ram_kwh", "kg_co2", "cpu_seconds")


def curve_metrics(curves: pd.DataFrame) -> pd.DataFrame:
    """Return the metrics of each run's curve, indexed by `run_id`.

    Columns: `controller`, `task`, `final_reward`, `auc_own` (normalised by the run's own range, as published)
    and `auc_study` (normalised by the range of all curves of the task, for ranking; 0.5 if that range is a
    single value), both NaN for fewer than `FEWEST_POINTS` points. Raises ValueError for a curve whose steps
    do not increase.
    """
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
                    "auc_study": auc(steps, values, *((low, high) if low < high else ())),
                }
            )
    columns = ["run_id", "controller", "task", "final_reward", "auc_own", "auc_study"]
    return pd.DataFrame(rows, columns=columns).set_index("run_id")


def mean_curves(curves: pd.DataFrame) -> pd.DataFrame:
    """Return the mean learning curve of each controller on each task, at the steps that all its runs share.

    Columns: `task`, `controller`, `runs` (their number), `env_steps`, `mean`, and `low` and `high`, the ends
    of the 95% interval by Student's t (NaN for one run).
    """
    frames = []
    for (task, controller), of_cell in curves.groupby(["task", "controller"], sort=False):
        table = _common_table(of_cell)
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
    """Return curves interpolated to common steps, for `mean_curves` of runs with points at different steps.

    The runs of a controller on a task get a point at every step that any of them has, within the span that
    all of them cover, by linear interpolation. Runs without a common span are returned unchanged.
    """
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
    """Return statistics of each controller's scores over its runs on all tasks, indexed by `controller`.

    Columns: `runs`, `mean`, `std` (ddof = 1; NaN for one run), the interquartile mean `iqm`, and `iqm_low`
    and `iqm_high`, the ends of its 95% interval by the stratified bootstrap. The interval is NaN if any task
    has only one run: resampling a single run would look like certainty.
    """
    rows = []
    for controller, of_controller in scores.groupby("controller", sort=False):
        statistics = mean_std(of_controller["final_reward"].to_numpy())
        tasks = list(_by_task(of_controller).values())
        interval, known = interquartile_mean(tasks), _several_runs(tasks)
        rows.append(
            {
                "controller": controller,
                "runs": statistics.count,
                "mean": statistics.mean,
                "std": statistics.std,
                "iqm": interval.estimate,
                "iqm_low": interval.low if known else np.nan,
                "iqm_high": interval.high if known else np.nan,
            }
        )
    columns = ["controller", "runs", "mean", "std", "iqm", "iqm_low", "iqm_high"]
    return pd.DataFrame(rows, columns=columns).set_index("controller")


def improvements(scores: pd.DataFrame) -> pd.DataFrame:
    """Return the probability of improvement of each ordered pair of controllers, over their common tasks.

    Columns: `a`, `b`, `probability` that a run of `a` scores above a run of `b`, and `low` and `high`, the
    ends of its 95% interval. A task is common if both have several runs on it; pairs without one are left
    out. The interval is NaN if it would be a point, as where every run of one controller scores above every
    run of the other: all resamples are then alike, however few the runs, which would look like certainty.
    """
    by_controller = {
        str(controller): _by_task(of_controller)
        for controller, of_controller in scores.groupby("controller", sort=False)
    }
    rows = []
    for a, b in permutations(by_controller, 2):
        pair = [by_controller[name] for name in (a, b)]
        common = [task for task in pair[0] if all(len(of_tasks.get(task, ())) > 1 for of_tasks in pair)]
        if not common:
            continue
        left, right = ([of_tasks[task] for task in common] for of_tasks in pair)
        found = probability_of_improvement(left, right)
        low, high = (found.low, found.high) if found.low < found.high else (np.nan, np.nan)
        rows.append({"a": a, "b": b, "probability": found.estimate, "low": low, "high": high})
    return pd.DataFrame(rows, columns=["a", "b", "probability", "low", "high"])


def learner_pairs(episodes: pd.DataFrame, metric: str = "return") -> pd.DataFrame:
    """Return the comparison of each pair of controllers of a task on common episodes, as `headway compare`.

    `episodes`: `RunSelection.evaluations` of one mode with `final=True`, of runs with the same
    `evaluation.seed`, so that an `episode_seed` is the same episode for all. Columns: `task`, `a`, `b`; the
    mean `difference` of the metric, a minus b, and `low` and `high`, the ends of its 95% interval over the
    seeds of both and the episodes; `p` and `p_holm`, corrected for the number of pairs of the task; and
    `seeds_needed` per controller to show such a difference (see `LearnerDifference`). Tasks with fewer than
    two common episodes are left out. Raises ValueError for an episode that a run has several times.
    """
    if episodes.duplicated(["run_id", "episode_seed"]).any():
        raise ValueError("a run has an episode several times: take evaluations(mode=..., final=True)")
    rows = []
    for task, of_task in episodes.groupby("task", sort=False):
        learned = {
            str(controller): played.pivot_table(index="run_id", columns="episode_seed", values=metric)
            for controller, played in of_task.groupby("controller", sort=False)
        }
        for pair in pairs_on_common_episodes(metric, learned):
            found = pair.difference.interval
            ends = {"difference": found.estimate, "low": found.low, "high": found.high}
            p_values = {"p": pair.difference.p_value, "p_holm": pair.corrected_p}
            needed = {"seeds_needed": pair.seeds_needed}
            rows.append({"task": task, "a": pair.a, "b": pair.b, **ends, **p_values, **needed})
    columns = ["task", "a", "b", "difference", "low", "high", "p", "p_holm", "seeds_needed"]
    return pd.DataFrame(rows, columns=columns)


def pairs_on_common_episodes(metric: str, learned: Mapping[str, pd.DataFrame]) -> list[PairRow]:
    """Compare each pair of learners on the episodes that all of them have; none if these are fewer than two.

    `learned`: values of a metric, runs x episode seeds.
    """
    whole = {name: episodes.dropna(axis="columns") for name, episodes in learned.items()}
    common = [
        seed
        for seed in next(iter(whole.values())).columns
        if all(seed in episodes.columns for episodes in whole.values())
    ]
    if len(common) < 2:
        return []
    values = {name: episodes[common].to_numpy().tolist() for name, episodes in whole.items()}
    return pair_rows(metric, values, combinations(values, 2))


def rank_table(scores: pd.DataFrame) -> pd.DataFrame:
    """Return the ranks of controllers (index) on each task and their `average_rank`, best first.

    `scores`: one row per task and one column per controller; 1 is the rank of the highest.
    """
    table = pd.DataFrame(ranks(scores.to_numpy()).T, scores.columns, scores.index).rename_axis("controller")
    table = table.assign(average_rank=table.mean(axis="columns"))
    return table.sort_values("average_rank", kind="stable")


def rank_pairs(scores: pd.DataFrame) -> pd.DataFrame:
    """Return Wilcoxon's signed-rank test over tasks of each pair of controllers, best average rank first.

    `scores`: as in `rank_table`, comparable between tasks. Columns: `a`, `b`, the mean `difference`, `p` and
    `p_holm`, corrected for the number of pairs.
    """
    rows = [
        {"a": a, "b": b, "difference": float(values.mean()), "p": signed_rank_p_value(values)}
        for a, b in combinations(rank_table(scores).index, 2)
        for values in [(scores[a] - scores[b]).to_numpy()]
    ]
    found = pd.DataFrame(rows, columns=["a", "b", "difference", "p"])
    return found.assign(p_holm=holm(found["p"]))


def profiles(scores: pd.DataFrame, thresholds: ArrayLike | None = None) -> pd.DataFrame:
    """Return the performance profile of each controller: the share of its runs above each threshold.

    Columns: `controller`, `threshold`, `share`, and `low` and `high`, the ends of the 95% interval (NaN if
    any task has only one run). Default `thresholds`: `even_thresholds(scores)`.
    """
    points = np.asarray(even_thresholds(scores) if thresholds is None else thresholds, np.float64)
    frames = []
    for controller, of_controller in scores.groupby("controller", sort=False):
        tasks = list(_by_task(of_controller).values())
        band = _known_band(performance_profile(tasks, points), tasks)
        frames.append(_band_frame(str(controller), "threshold", points, band, "share"))
    columns = ["controller", "threshold", "share", "low", "high"]
    return pd.concat(frames, ignore_index=True) if frames else pd.DataFrame(columns=columns)


def even_thresholds(scores: pd.DataFrame) -> NDArray[np.float64]:
    """Return evenly spaced thresholds over the range of all scores and 2% beyond, for `profiles`."""
    least, most = scores["final_reward"].min(), scores["final_reward"].max()
    margin = 0.02 * (most - least) or 1.0
    return np.linspace(least - margin, most + margin, _PROFILE_POINTS)


def efficiency(curves: pd.DataFrame) -> pd.DataFrame:
    """Return the sample-efficiency curve of each controller, at the steps common to all its runs.

    Columns: `controller`, `env_steps`, the interquartile mean `iqm` over all tasks, and `low` and `high`, the
    ends of its 95% interval (NaN if any task has only one run). A controller whose runs share no steps is
    left out.
    """
    frames = []
    for controller, of_controller in curves.groupby("controller", sort=False):
        tables = [_common_table(of_task) for _, of_task in of_controller.groupby("task", sort=False)]
        steps = tables[0].index
        for table in tables[1:]:
            steps = steps.intersection(table.index)
        if len(steps):
            values = [table.loc[steps].to_numpy().T for table in tables]
            band = _known_band(sample_efficiency(values), values)
            frames.append(_band_frame(str(controller), "env_steps", steps.to_numpy(), band, "iqm"))
    columns = ["controller", "env_steps", "iqm", "low", "high"]
    return pd.concat(frames, ignore_index=True) if frames else pd.DataFrame(columns=columns)


def costs(summaries: pd.DataFrame) -> pd.DataFrame:
    """Return mean costs per run of each task and controller (the index), from `RunSelection.summaries`.

    Columns: the means of `kwh`, its parts `cpu_kwh`, `gpu_kwh` and `ram_kwh`, `kg_co2` and `cpu_seconds`;
    their standard deviations over runs, `..._std` (ddof = 1; NaN for one run); and the number of `runs`. Runs
    without an energy measurement are left out. Unknown values are NaN, never 0; CO2 is NaN unless it is known
    for every such run.
    """
    selected = summaries.reindex(columns=["task", "controller", *_COSTS])
    measured = selected[selected["kwh"].notna()].astype(dict.fromkeys(_COSTS, np.float64))
    grouped = measured.groupby(["task", "controller"], sort=False)
    deviations = grouped[list(_COSTS)].std(ddof=1).add_suffix("_std")
    found = grouped[list(_COSTS)].mean().join(deviations).assign(runs=grouped.size())
    complete = grouped["kg_co2"].count() == found["runs"]
    return found.assign(**{name: found[name].where(complete) for name in ("kg_co2", "kg_co2_std")})


def normalised_by_rules(
    frame: pd.DataFrame, column: str, rules: Mapping[str, tuple[float, float]]
) -> pd.DataFrame:
    """Return `frame` with its `column` normalised per task: 0 for random play, 1 for the best rule.

    `rules` gives (random play, best rule) by task; `frame` has a column `task`. Raises ValueError for a task
    without rules, or whose best rule does not score above random play.
    """
    missing = sorted(set(frame["task"]) - set(rules))
    if missing:
        raise ValueError(f"random play and best rule are unknown for {', '.join(missing)}")
    scaled = [
        of_task.assign(**{column: normalised(of_task[column].to_numpy(), *rules[str(task)])})
        for task, of_task in frame.groupby("task", sort=False)
    ]
    return pd.concat(scaled).loc[frame.index]


def _by_task(scores: pd.DataFrame) -> dict[str, NDArray[np.float64]]:
    return {
        str(task): of_task["final_reward"].to_numpy(np.float64)
        for task, of_task in scores.groupby("task", sort=False)
    }


def _common_table(curves: pd.DataFrame) -> pd.DataFrame:
    """Return values by step (index, increasing) and run (columns), at the steps that all runs have."""
    return curves.pivot_table(index="env_steps", columns="run_id", values="value").dropna().sort_index()


def _several_runs(tasks: Sequence[NDArray[np.float64]]) -> bool:
    """Return whether every task, with runs along its first axis, has more than one run."""
    return all(len(task) > 1 for task in tasks)


def _known_band(band: Band, tasks: Sequence[NDArray[np.float64]]) -> Band:
    """Return the band with NaN ends if any task has one run only: resampling it would give no width."""
    if _several_runs(tasks):
        return band
    return Band(band.estimate, np.full_like(band.low, np.nan), np.full_like(band.high, np.nan))


def _band_frame(
    controller: str, axis: str, points: Sequence[float] | NDArray[np.float64], band: Band, name: str
) -> pd.DataFrame:
    columns = {axis: points, name: band.estimate, "low": band.low, "high": band.high}
    return pd.DataFrame({"controller": controller, **columns})
