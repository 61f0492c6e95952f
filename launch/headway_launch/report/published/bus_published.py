"""Comparison of a study on `bus_published` with BusEnv's published table."""

import math
from typing import TYPE_CHECKING, Any

import pandas as pd

from headway.stats.curves import FEWEST_POINTS
from headway_launch.console.number_formats import MISSING, formatted, with_deviation
from headway_launch.report.elements import Part, Section, Table
from headway_launch.report.published.episode_metrics import (
    env_of,
    published_results,
    published_values,
    tasks_of,
)
from headway_launch.report.study_data import StudyData, mean_of_known
from headway_launch.studies.runs import configuration, curve_points

if TYPE_CHECKING:
    from headway.store.index import RunRow

ENVIRONMENT = "bus_published"
_COMPARED = {"final_reward": "final reward", "auc": "AUC", "kwh": "energy per run"}
_SEEDS_WITH_VALUE = {
    "final_reward": "seeds in which episodes ended during training",
    "auc": f"seeds with at least {FEWEST_POINTS} points in the training curve",
}
"""Seeds over which a metric of the training curve is averaged."""
_FEWEST_ALGORITHMS = 3
"""Number of algorithms that a rank correlation needs."""
_TESTS = ("spearman", "kendall")
_OTHER_ACTIONS = ("waits", "service_visits", "services_refused")
"""Metrics that count the actions of a bus other than moving."""


def bus_published_section(data: StudyData) -> Section | None:
    """Compare the study with the published table, including rank correlations; None for other
    environments."""
    tasks = tasks_of(data, ENVIRONMENT)
    if not tasks:
        return None
    title = "Comparison with BusEnv's published table"
    if data.training_metrics is None:
        return Section(
            "busenv",
            title,
            ["No episode ended during training, so there is no curve to compare with the published one."],
        )
    body: list[Part] = [
        "Each value of BusEnv's Table 3 stands beside ours, computed in the same way: from the curve of "
        "training episodes, the reward per day summed over the buses, averaged over the last 20% of the "
        "steps, and the AUC normalised by the run's own range; mean ± standard deviation over seeds."
    ]
    for place, task in enumerate(tasks):
        body += _comparison(data, task, f"_{place + 1}" if len(tasks) > 1 else "")
        body += _rules_and_learners(data, task)
    return Section("busenv", title, [*body, *published_results(ENVIRONMENT).caveats])


def _comparison(data: StudyData, task: str, number: str) -> list[Part]:
    published, ours = published_values(ENVIRONMENT), {}
    for controller, members in data.on(task).items():
        if members[0].algorithm in published.index:
            ours[controller] = {"algorithm": members[0].algorithm, **_training_results(data, members)}
    if not ours:
        return [f"None of the published algorithms was trained{data.where(task)}."]
    table = pd.DataFrame.from_dict(ours, orient="index").join(
        published.add_suffix("_published"), on="algorithm"
    )
    table["final_reward_rank"] = table["final_reward"].rank(ascending=False)
    of_all = published["final_reward"].rank(ascending=False)
    table["final_reward_published_rank"] = table["algorithm"].map(of_all)
    rows = [
        [
            str(controller),
            str(int(row["seeds"])),
            with_deviation(row["final_reward_published"], row["final_reward_std_published"], 2),
            with_deviation(row["final_reward"], row["final_reward_std"], 2),
            formatted(row["final_reward_published_rank"]),
            formatted(row["final_reward_rank"]),
            f"{row['auc_published']:.3f}",
            with_deviation(row["auc"], row["auc_std"], 3),
            formatted(row["kwh_published"]),
            formatted(row["kwh"]),
        ]
        for controller, row in table.iterrows()
    ]
    parts: list[Part] = [
        Table(
            f"busenv_table3{number}",
            f"BusEnv's Table 3 and this study{data.where(task)}. Rank 1 is the highest final reward; the "
            f"published ranks are among all {len(published)} algorithms, ours among the {len(table)} of this "
            "table.",
            [
                "controller", "seeds", "published: final reward", "here: final reward", "published: rank",
                "here: rank", "published: AUC", "here: AUC", "published: kWh per run", "here: kWh per run",
            ],
            rows,
            table.rename_axis("controller").reset_index(),
        )
    ]  # fmt: skip
    return [
        _coverage(data, task, table),
        *parts,
        _first_and_last_rows(data, task, table, number),
        *_missing_seeds(table),
        *_correlations(table, number),
        *_identical_policies(data, task, [str(controller) for controller in table.index]),
    ]


def _first_and_last_rows(data: StudyData, task: str, table: pd.DataFrame, number: str) -> Table:
    """Return the ends of the training curves beside those of the authors' released runs."""
    points = curve_points(data.runs, "training/return")
    by_run = (
        points[points["task"] == task].sort_values("env_steps").groupby(["controller", "run_id"])["value"]
    )
    ends = pd.DataFrame({"first": by_run.first(), "last": by_run.last()}).groupby("controller")
    buses = int(env_of(data, task)["args"]["agents"])
    exact = (
        (buses * ends.mean())
        .join((buses * ends.std()).add_suffix("_std"))
        .join(table[["first_reward_published", "last_reward_published"]], how="right")
    )
    rows = [
        [
            str(controller),
            formatted(row["first_reward_published"], 1),
            with_deviation(row["first"], row["first_std"], 1),
            formatted(row["last_reward_published"], 1),
            with_deviation(row["last"], row["last_std"], 1),
        ]
        for controller, row in exact.iterrows()
    ]
    return Table(
        f"busenv_rows{number}",
        f"Ends of the training curves{data.where(task)}: the first and the last row of one of the authors' "
        "released runs (each the mean over the last 100 days), and the first and the last iteration here in "
        "which days ended, mean ± standard deviation over seeds. The first rows show chance.",
        ["controller", "released: first row", "here: first", "released: last row", "here: last"],
        rows,
        exact.rename_axis("controller").reset_index(),
    )


def _coverage(data: StudyData, task: str, table: pd.DataFrame) -> str:
    """Name the published algorithms with finished runs, their numbers of seeds, and those without runs."""
    results = published_results(ENVIRONMENT)
    here = [name for name in results.results if name in set(table["algorithm"])]
    lacking = [name for name in results.results if name not in here]
    fewest, most = int(table["seeds"].min()), int(table["seeds"].max())
    seeds = f"{fewest}" if fewest == most else f"{fewest} to {most}"
    text = (
        f"Of the {len(results.results)} published algorithms, each with {results.seeds} seeds, {len(here)} "
        f"{'has' if len(here) == 1 else 'have'} finished runs here{data.where(task)}, with {seeds} "
        f"{'seed' if most == 1 else 'seeds'}{' each' if len(table) > 1 and fewest == most else ''}"
    )
    return f"{text}; there are no finished runs of {', '.join(lacking)}." if lacking else f"{text}."


def _missing_seeds(table: pd.DataFrame) -> list[Part]:
    """Name the controllers with seeds that have no final reward or AUC."""
    lines: list[Part] = []
    for name, seeds in _SEEDS_WITH_VALUE.items():
        fewer = table[table[f"{name}_seeds"] < table["seeds"]]
        which = [
            f"{controller} ({row[f'{name}_seeds']} of {row['seeds']})" for controller, row in fewer.iterrows()
        ]
        if which:
            lines.append(f"The {_COMPARED[name]} is averaged only over {seeds}: {', '.join(which)}.")
    return lines


def _training_results(data: StudyData, members: list["RunRow"]) -> dict[str, float]:
    """Return the results of a cell's runs as the paper defines them."""
    assert data.training_metrics is not None
    runs = [row.run_id for row in members]
    buses = int(configuration(members[0].directory)["env"]["args"]["agents"])
    curves = data.training_metrics.loc[runs]
    reward = mean_of_known(buses * curves["final_reward"])
    auc = mean_of_known(curves["auc_own"])
    return {
        "seeds": len(members),
        "final_reward": reward.mean,
        "final_reward_std": reward.std,
        "final_reward_seeds": reward.count,
        "auc": auc.mean,
        "auc_std": auc.std,
        "auc_seeds": auc.count,
        "kwh": float(data.summaries.loc[runs, "kwh"].mean()),
    }


def _correlations(table: pd.DataFrame, number: str) -> list[Part]:
    """Return Spearman's and Kendall's rank correlations over the algorithms with exactly one setting."""
    repeated = sorted(set(table["algorithm"][table["algorithm"].duplicated()]))
    once = table[~table["algorithm"].isin(repeated)]
    found = {name: _rank_correlation(once, name) for name in _COMPARED}
    rows = [
        [words, str(int(found[name]["algorithms"])), *(_correlation(found[name], test) for test in _TESTS)]
        for name, words in _COMPARED.items()
    ]
    parts: list[Part] = [
        Table(
            f"busenv_ranks{number}",
            "Rank correlation between the published results and ours, over algorithms; ties get their mean "
            "rank. In brackets: the probability of a tau at least as far from 0 if the two orders were "
            "independent.",
            ["result", "algorithms", "Spearman's rho", "Kendall's tau"],
            rows,
            pd.DataFrame.from_dict(found, orient="index").rename_axis("metric").reset_index(),
        )
    ]
    if repeated:
        parts.append(f"Excluded, because they were trained with several settings: {', '.join(repeated)}.")
    if without := [words for name, words in _COMPARED.items() if not math.isfinite(found[name]["spearman"])]:
        parts.append(
            f"No rank correlation is given for {', '.join(without)}: it needs at least {_FEWEST_ALGORITHMS} "
            "algorithms with both values, and values that differ."
        )
    return parts


def _identical_policies(data: StudyData, task: str, controllers: list[str]) -> list[Part]:
    """Name learners that are identical in the greedy evaluation, or only move, with all seeds on all days."""
    if data.mode != "greedy":
        return []
    alike: dict[tuple[float, ...] | None, list[str]] = {}
    for name in controllers:
        days = data.by_seed(task, name, data.column)
        if _only_moved(data, task, name):
            alike.setdefault(None, []).append(name)
        elif days.size and (days == days.iloc[0]).to_numpy().all():
            alike.setdefault((*days.columns, *days.iloc[0]), []).append(name)
    return [
        f"In the last greedy evaluation, {', '.join(names)} "
        + (
            "always moved, with every seed on every day: they learned the same policy"
            if days is None
            else f"have the same {data.metric_label} to the last digit, with every seed on "
            "every day: they learned the same policy as far as those days show"
        )
        + ", so their ranks differ only by the actions sampled during training."
        for days, names in alike.items()
        if len(names) > 1
    ]


def _only_moved(data: StudyData, task: str, controller: str) -> bool:
    """Return whether all buses always moved in the last evaluation; False if the counts were not logged."""
    made = [data.by_seed(task, controller, name).to_numpy() for name in ("moves", *_OTHER_ACTIONS)]
    moves, *others = made
    return bool(moves.size and (moves > 0).all() and all(n.size and (n == 0).all() for n in others))


def _rank_correlation(table: pd.DataFrame, name: str) -> dict[str, float]:
    from scipy import stats

    both = table[[f"{name}_published", name]].astype(float).dropna()
    found: dict[str, float] = {"algorithms": len(both)}
    varies = all(len(set(both[column])) > 1 for column in both)
    computing: dict[str, Any] = {"spearman": stats.spearmanr, "kendall": stats.kendalltau}
    for test, compute in computing.items():
        enough = len(both) >= _FEWEST_ALGORITHMS and varies
        known: Any = compute(both.iloc[:, 0], both.iloc[:, 1]) if enough else None
        found[test] = float("nan") if known is None else float(known.statistic)
        if test == "kendall":  # scipy's p-value of Spearman's rho is valid only for many pairs
            found["kendall_p"] = float("nan") if known is None else float(known.pvalue)
    return found


def _correlation(found: dict[str, float], test: str) -> str:
    if not math.isfinite(found[test]):
        return MISSING
    return f"{found[test]:+.2f}" + (f" ({found['kendall_p']:.2g})" if test == "kendall" else "")


def _rules_and_learners(data: StudyData, task: str) -> list[Part]:
    """Compare learners with the two rules that never hold a bus, in the units of the published table."""
    buses = int(env_of(data, task)["args"]["agents"])
    values = {
        rule: buses * float(data.by_episode(task, rule).mean())
        for rule in ("always_move", "move_with_service")
        if rule in data.ranked_rules(task)
    }
    if data.column != "return" or "always_move" not in values:
        return []
    moving = values["always_move"]
    days = {name: data.by_seed(task, name, data.column).to_numpy() for name in data.on(task)}
    means = {name: buses * float(values.mean()) for name, values in days.items() if values.size}
    near = [name for name, mean in means.items() if abs(mean - moving) <= 0.05 * abs(moving)]
    text = (
        f"The rule that always moves earns {formatted(moving)} here, summed over the buses. On the same "
        f"days, in the last evaluation, {len(near)} of {len(means)} learners are within 5% of it"
        + (f" ({', '.join(near)})." if near else ".")
    )
    sampled_more = [
        str(name)
        for name, members in data.on(task).items()
        if name in near and _training_results(data, members)["final_reward"] > moving + 0.2 * abs(moving)
    ]
    if sampled_more and data.mode == "greedy":
        text += (
            f" During training, with sampled actions, {', '.join(sampled_more)} exceeded that rule by more "
            "than a fifth."
        )
        never = [name for name in sampled_more if _has_no_visits(data, task, name)]
        if never:
            text += (
                f" With greedy actions, {', '.join(never)} never visited the service centre on those days."
            )
    if "move_with_service" in values:
        text += (
            " The rule that always moves, but visits the service centre once half of the uptime is used up, "
            f"earns {formatted(values['move_with_service'])}. "
        )
        text += (
            "So always moving is not optimal."
            if values["move_with_service"] > moving
            else "So such visits do not pay here."
        )
    text += (
        " This environment has no waiting passengers and no random travel times, so holding a bus can hardly "
        "gain anything: the table shows how reliably an algorithm with these settings learns to keep moving, "
        "not which algorithm controls buses better. For that, use the study `bus_study`."
    )
    return [text]


def _has_no_visits(data: StudyData, task: str, controller: str) -> bool:
    """Return whether a learner never visited the service centre in the last evaluation; False if unknown."""
    visits = data.by_seed(task, controller, "service_visits").to_numpy()
    return bool(visits.size and (visits == 0).all())
