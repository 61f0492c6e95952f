"""The section that sets a study on `bus_published` beside the table that was published of it."""

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pandas as pd

from headway.stats import FEWEST_POINTS
from headway_launch.report.parts import MISSING, Part, Section, Table, figure, with_deviation
from headway_launch.report.published.episodes import env_of, tasks_of
from headway_launch.report.study_data import StudyData, over_known
from headway_launch.studies.runs import configuration

if TYPE_CHECKING:
    from headway.store.index import RunRow

ENVIRONMENT = "bus_published"
_FIGURES = {"final_reward": "final reward", "auc": "AUC", "kwh": "energy a run"}
_WHY_FEWER = {
    "final_reward": "in which episodes ended in training",
    "auc": f"whose training curve has at least {FEWEST_POINTS} points",
}
"""Of which seeds there is a figure of the training curve."""
_FEWEST = 3
"""Algorithms of which a rank correlation is given."""
_PUBLISHED_SEEDS = 50
_OTHER_ACTIONS = ("waits", "service_visits", "services_refused")
"""Metrics that count what a bus did but move."""


def published_figures() -> pd.DataFrame:
    """By algorithm: `final_reward` (sum over buses), `final_reward_std`, `auc`; `kwh` a run where known."""
    path = Path(__file__).with_name("busenv_table3.csv")
    return pd.read_csv(path, comment="#").set_index("algorithm")


def busenv_section(data: StudyData) -> Section | None:
    """Both tables side by side, rank correlations, and what can be compared; None for other environments."""
    tasks = tasks_of(data, ENVIRONMENT)
    if not tasks:
        return None
    if data.training_figures is None:
        body: list[Part] = ["No episode ended in training: there is no curve such as is published."]
        return Section("busenv", "Beside the published table", body)
    body = [_what_is_compared()]
    for place, task in enumerate(tasks):
        body += _beside(data, task, f"_{place + 1}" if len(tasks) > 1 else "")
        body += _what_it_shows(data, task)
    return Section("busenv", "Beside the published table", [*body, *_not_comparable()])


def _what_is_compared() -> str:
    return (
        "Beside each figure of BusEnv's Table 3 stands ours in the same form: of the curve of training "
        "episodes, the reward of a day summed over the buses, its mean over the last 20% of the steps, and "
        "the AUC by the run's own range; mean ± standard deviation over seeds."
    )


def _beside(data: StudyData, task: str, number: str) -> list[Part]:
    published, ours = published_figures(), {}
    for controller, members in data.on(task).items():
        if members[0].algorithm in published.index:
            ours[controller] = {"algorithm": members[0].algorithm, **_figures_of(data, members)}
    if not ours:
        return [f"None of the algorithms published was trained{data.where(task)}."]
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
            figure(row["final_reward_published_rank"]),
            figure(row["final_reward_rank"]),
            f"{row['auc_published']:.3f}",
            with_deviation(row["auc"], row["auc_std"], 3),
            figure(row["kwh_published"]),
            figure(row["kwh"]),
        ]
        for controller, row in table.iterrows()
    ]
    parts: list[Part] = [
        Table(
            f"busenv_table3{number}",
            f"BusEnv's Table 3 and this study{data.where(task)}. Ranks: 1 is the highest final reward; the "
            f"published ones are among all {len(published)} algorithms, ours among the {len(table)} of this "
            "table.",
            [
                "controller", "seeds", "published: final reward", "here", "published: rank", "here",
                "published: AUC", "here", "published: kWh a run", "here",
            ],
            rows,
            table.rename_axis("controller").reset_index(),
        )
    ]  # fmt: skip
    return [
        _what_is_there(data, task, table),
        *parts,
        *_over_fewer_seeds(table),
        *_correlations(table, number),
        *_same_policies(data, task, [str(controller) for controller in table.index]),
    ]


def _what_is_there(data: StudyData, task: str, table: pd.DataFrame) -> str:
    """Which of the published algorithms have finished runs, of how many seeds, and which have none."""
    published = published_figures().index
    here = [name for name in published if name in set(table["algorithm"])]
    lacking = [name for name in published if name not in here]
    fewest, most = int(table["seeds"].min()), int(table["seeds"].max())
    seeds = f"{fewest}" if fewest == most else f"{fewest} to {most}"
    said = (
        f"Of the {len(published)} algorithms published, each with {_PUBLISHED_SEEDS} seeds, {len(here)} "
        f"{'has' if len(here) == 1 else 'have'} finished runs here{data.where(task)}, with {seeds} "
        f"{'seed' if most == 1 else 'seeds'}{' each' if len(table) > 1 and fewest == most else ''}"
    )
    return f"{said}; none of {', '.join(lacking)} has finished." if lacking else f"{said}."


def _over_fewer_seeds(table: pd.DataFrame) -> list[Part]:
    """A line for each figure of the training curve that some seeds of a controller do not have."""
    said: list[Part] = []
    for name, why in _WHY_FEWER.items():
        fewer = table[table[f"{name}_seeds"] < table["seeds"]]
        which = [
            f"{controller} ({row[f'{name}_seeds']} of {row['seeds']})" for controller, row in fewer.iterrows()
        ]
        if which:
            said.append(f"The {_FIGURES[name]} is over those seeds only {why}: {', '.join(which)}.")
    return said


def _figures_of(data: StudyData, members: list["RunRow"]) -> dict[str, float]:
    """Of the runs of a cell, in the published form."""
    assert data.training_figures is not None
    runs = [row.run_id for row in members]
    buses = int(configuration(members[0].directory)["env"]["args"]["agents"])
    curves = data.training_figures.loc[runs]
    reward = over_known(buses * curves["final_reward"])
    auc = over_known(curves["auc_own"])
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
    """Spearman's and Kendall's rank correlation over the algorithms of which there is one setting."""
    repeated = sorted(set(table["algorithm"][table["algorithm"].duplicated()]))
    once = table[~table["algorithm"].isin(repeated)]
    found = {name: _rank_correlation(once, name) for name in _FIGURES}
    rows = [
        [words, str(int(found[name]["algorithms"])), *(_correlation(found[name], test) for test in _TESTS)]
        for name, words in _FIGURES.items()
    ]
    parts: list[Part] = [
        Table(
            f"busenv_ranks{number}",
            "Rank correlation over algorithms of the published figures with ours; ties have the mean of "
            "their ranks. In brackets the probability of a tau as far from 0 if the orders had nothing to do "
            "with each other.",
            ["figure", "algorithms", "Spearman's rho", "Kendall's tau"],
            rows,
            pd.DataFrame.from_dict(found, orient="index").rename_axis("figure").reset_index(),
        )
    ]
    if repeated:
        parts.append(f"Left out of it, as there is more than one setting of each: {', '.join(repeated)}.")
    if without := [words for name, words in _FIGURES.items() if not math.isfinite(found[name]["spearman"])]:
        parts.append(
            f"There is no correlation of {', '.join(without)}: it needs at least {_FEWEST} algorithms of "
            "which both figures are known, and figures that differ."
        )
    return parts


def _same_policies(data: StudyData, task: str, controllers: list[str]) -> list[Part]:
    """Which learners' greedy evaluations are the same, or hold nothing but moves, on all seeds and days."""
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
        f"Played greedily in the last evaluation, {', '.join(names)} "
        + (
            "did nothing but move, all seeds on all days: they came to the same policy (always moving)"
            if days is None
            else f"have the same {data.what} to the last digit, all seeds on all days: they came to the same "
            "policy, as far as those days show"
        )
        + ", so that ranks among them are of their drawn actions only."
        for days, names in alike.items()
        if len(names) > 1
    ]


def _only_moved(data: StudyData, task: str, controller: str) -> bool:
    """Whether all buses always moved in the last evaluation; False where not known."""
    made = [data.by_seed(task, controller, name).to_numpy() for name in ("moves", *_OTHER_ACTIONS)]
    moves, *others = made
    return bool(moves.size and (moves > 0).all() and all(n.size and (n == 0).all() for n in others))


_TESTS = ("spearman", "kendall")


def _rank_correlation(table: pd.DataFrame, name: str) -> dict[str, float]:
    from scipy import stats

    both = table[[f"{name}_published", name]].astype(float).dropna()
    found: dict[str, float] = {"algorithms": len(both)}
    varies = all(len(set(both[column])) > 1 for column in both)
    computing: dict[str, Any] = {"spearman": stats.spearmanr, "kendall": stats.kendalltau}
    for test, compute in computing.items():
        known: Any = compute(both.iloc[:, 0], both.iloc[:, 1]) if len(both) >= _FEWEST and varies else None
        found[test] = float("nan") if known is None else float(known.statistic)
        if test == "kendall":  # for Spearman's rho scipy has it for many pairs only
            found["kendall_p"] = float("nan") if known is None else float(known.pvalue)
    return found


def _correlation(found: dict[str, float], test: str) -> str:
    if not math.isfinite(found[test]):
        return MISSING
    return f"{found[test]:+.2f}" + (f" ({found['kendall_p']:.2g})" if test == "kendall" else "")


def _what_it_shows(data: StudyData, task: str) -> list[Part]:
    """Where the rules come to, in the same units."""
    buses = int(env_of(data, task)["args"]["agents"])
    values = {
        rule: buses * float(data.by_day(task, rule).mean())
        for rule in ("always_move", "move_with_service")
        if rule in data.ranked_rules(task)
    }
    if data.column != "return" or "always_move" not in values:
        return []
    moving = values["always_move"]
    days = {name: data.by_seed(task, name, data.column).to_numpy() for name in data.on(task)}
    means = {name: buses * float(values.mean()) for name, values in days.items() if values.size}
    near = [name for name, mean in means.items() if abs(mean - moving) <= 0.05 * abs(moving)]
    said = (
        f"A rule that always moves comes to {figure(moving)} here, summed over the buses. On the "
        f"same days, in the last evaluation, {len(near)} of {len(means)} learners come within 5% of that"
        + (f" ({', '.join(near)})." if near else ".")
    )
    drawn = [
        str(name)
        for name, members in data.on(task).items()
        if name in near and _figures_of(data, members)["final_reward"] > moving + 0.2 * abs(moving)
    ]
    if drawn and data.mode == "greedy":
        said += (
            f" While training, where actions are drawn, {', '.join(drawn)} came to more than that rule "
            "by over a fifth."
        )
        never = [name for name in drawn if _has_no_visits(data, task, name)]
        if never:
            said += f" Played greedily, {', '.join(never)} never went to the service centre on those days."
    if "move_with_service" in values:
        said += (
            f" A rule that moves too, but goes to the service centre when half of the uptime is used up, "
            f"comes to {figure(values['move_with_service'])}. "
        )
        said += (
            "So always moving is not the best there is."
            if values["move_with_service"] > moving
            else "So such visits do not pay here."
        )
    said += (
        " There are no passengers to be made to wait and no times that vary, so that hardly anything can be "
        "gained by holding a bus: the table tells how surely an algorithm with these settings comes to move "
        "always, not which one controls buses better. For that take the study `bus_study`."
    )
    return [said]


def _has_no_visits(data: StudyData, task: str, controller: str) -> bool:
    """Whether a learner's buses went to no service centre in the last evaluation; False where not known."""
    visits = data.by_seed(task, controller, "service_visits").to_numpy()
    return bool(visits.size and (visits == 0).all())


def _not_comparable() -> list[Part]:
    return [
        "What cannot be compared. The level of the rewards: the published routes, link times, loads and "
        "boardings are not public in full, so ours are of a scenario of our own, with other times and so "
        "another number of moves a day (recorded runs of theirs end with about 400 steps a day). The "
        "deviations: the recorded parameter files that were looked at (two runs of IPPO, one of MAA2C) all "
        "have the same seed, 321, so the published ± are hardly of different seeds; ours are. HAPPO's "
        "learning rates differ between their text and their recorded runs (see the preset `paper`).",
        "The service centre is a random stop, another for each of their two workers; here one for each copy, "
        "so that every curve is a mean over centres. Their batches end a day's experience where a "
        "day is cut short; here that is bootstrapped.",
        "Energy: theirs is of a whole server of 64 cores and 5 GPUs, which CodeCarbon counted for each run; "
        "ours is the share of one run by its CPU seconds. The order of the algorithms can be compared, "
        "not the kWh.",
    ]
