"""Comparison with the published merging study: which algorithms scale from one ramp lane to two."""

import math
from collections.abc import Mapping
from itertools import product
from typing import TYPE_CHECKING, Any

import pandas as pd

from headway.contracts import PublishedResult
from headway.stats.comparison import SEEDS_FOR_A_CLAIM
from headway.stats.intervals import difference_of_means
from headway_launch.console.number_formats import MISSING, with_ends
from headway_launch.report.elements import Part, Section, Table
from headway_launch.report.published.episode_metrics import (
    MetricColumn,
    env_of,
    formatted_row,
    interval_columns,
    learner_metrics,
    published_results,
    rule_metrics,
    seeds_of,
    tasks_of,
)
from headway_launch.report.study_data import StudyData

if TYPE_CHECKING:
    from headway.stats.samples import Interval

ONE_LANE, TWO_LANES = "merge", "merge_two_lane"
COLUMNS = (
    MetricColumn("reward", "reward", 1),
    MetricColumn("crash_rate", "crashes", 3),
    MetricColumn("merge_rate", "merged", 3),
    MetricColumn("mean_speed_ms", "speed, m/s", 2),
    MetricColumn("interventions", "interventions", 1),
)
SCALING_COLUMNS = COLUMNS[:4]
_DENSITY = 2
"""Density of the published runs."""
_UNPUBLISHED = PublishedResult(ranges={"reward": MISSING}, finding=MISSING)


def merge_section(data: StudyData) -> Section | None:
    """Compare rewards, crashes, merges and speeds with the published ranges, and one ramp lane with two.

    None for studies of other environments.
    """
    tasks = tasks_of(data, ONE_LANE, TWO_LANES)
    if not tasks:
        return None
    body: list[Part] = [
        "The study plots curves and prints no table; the ranges below are those that its text states for "
        f"the evaluation rewards, over 10,000 episodes at density {_DENSITY}. Its conclusion: MAPPO scales "
        "to two ramp lanes, MAACKTR gets worse, MADQN learns on neither.",
        _comparison(data, tasks),
    ]
    pairs = _pairs(data)
    for place, (one, two) in enumerate(pairs):
        body += _scaling(data, one, two, f"_{place + 1}" if len(pairs) > 1 else "")
    if not pairs:
        body.append(
            "These runs do not show how an algorithm scales: that needs runs with the same settings on "
            f"`{ONE_LANE}` and on `{TWO_LANES}`."
        )
    body += published_results(ONE_LANE).caveats
    return Section("merging", "Comparison with the published merging study", body)


def _comparison(data: StudyData, tasks: list[str]) -> Table:
    rows: list[list[str]] = []
    exact: list[dict[str, Any]] = []
    rules: set[int] = set()
    for task in tasks:
        published = _published(data, task)
        for name, row in learner_metrics(data, task, COLUMNS).iterrows():
            reported = published.get(str(row["algorithm"]), _UNPUBLISHED).ranges["reward"]
            rows.append([task, str(name), seeds_of(row), reported, *formatted_row(row, COLUMNS)])
            exact.append({"environment": task, "controller": name, "published_reward": reported, **row})
        for name, row in rule_metrics(data, task, COLUMNS).iterrows():
            rules.add(len(rows))
            rows.append([task, str(name), MISSING, MISSING, *formatted_row(row, COLUMNS)])
            exact.append({"environment": task, "controller": name, **row})
    return Table(
        "merging",
        "Reward per episode (sum over its steps of the mean over vehicles), share of episodes with a crash, "
        "share of CAVs that merged into the highway, their mean speed, and actions replaced by the "
        "supervisor: last evaluation, mean ± standard deviation over seeds. The published runs used the "
        "supervisor.",
        ["environment", "controller", "seeds", "published: reward", *(each.heading for each in COLUMNS)],
        rows,
        pd.DataFrame(exact),
        words=frozenset({0, 1, 3}),
        emphasised=frozenset(rules),
    )


def _published(data: StudyData, task: str) -> Mapping[str, PublishedResult]:
    """Return the results published for a task, by algorithm; none for another density of traffic."""
    env = env_of(data, task)
    return published_results(str(env["id"])).results if env["args"]["density"] == _DENSITY else {}


def _pairs(data: StudyData) -> list[tuple[str, str]]:
    """Return pairs of tasks that differ only in the number of ramp lanes."""
    pairs = product(tasks_of(data, ONE_LANE), tasks_of(data, TWO_LANES))
    return [(one, two) for one, two in pairs if env_of(data, one)["args"] == env_of(data, two)["args"]]


def _scaling(data: StudyData, one: str, two: str, number: str) -> list[Part]:
    """Return the table of each learner's change from one ramp lane to two."""
    both = [name for name in data.on(one) if name in data.on(two)]
    published = _published(data, two)
    rows, exact = [], []
    for name in both:
        members = data.on(one)[name]
        seeds = min(len(members), len(data.on(two)[name]))
        changes = {each.metric: _change(data, one, two, name, each.metric) for each in SCALING_COLUMNS}
        finding = published.get(members[0].algorithm, _UNPUBLISHED).finding
        shown = [_shown(changes[each.metric], each.decimals) for each in SCALING_COLUMNS]
        rows.append([name, str(seeds), *shown, finding, _conclusion(changes["reward"], seeds)])
        exact.append({"controller": name, "seeds": seeds, **interval_columns(changes)})
    if not rows:
        return [f"No learner was trained on both {one} and {two}."]
    return [
        Table(
            f"scaling{number}",
            f"{two} minus {one}: difference of the means over seeds, with its 95% interval by Welch's t.",
            ["controller", "seeds", *(each.heading for each in SCALING_COLUMNS), "published", "here"],
            rows,
            pd.DataFrame(exact),
            words=frozenset({0, 2 + len(SCALING_COLUMNS), 3 + len(SCALING_COLUMNS)}),
        )
    ]


def _change(data: StudyData, one: str, two: str, name: str, metric: str) -> "Interval | None":
    """Return the change of a metric's mean, or None if it was not logged or there is only one seed."""
    of_one, of_two = (data.by_seed(task, name, metric).mean(axis="columns") for task in (one, two))
    if min(len(of_one), len(of_two)) < 2:
        return None
    return difference_of_means(of_two.to_numpy(), of_one.to_numpy())


def _shown(change: "Interval | None", decimals: int) -> str:
    if change is None:
        return MISSING
    if math.isnan(change.low):
        return f"{change.estimate:+.{decimals}f}"
    decimals = with_ends(decimals, (change.low, change.high))
    return f"{change.estimate:+.{decimals}f} [{change.low:.{decimals}f}, {change.high:.{decimals}f}]"


def _conclusion(change: "Interval | None", seeds: int) -> str:
    if change is None:
        return MISSING
    conclusion = "no difference shown"
    if change.excludes_zero:
        conclusion = "gains" if change.estimate > 0 else "loses"
    return conclusion if seeds >= SEEDS_FOR_A_CLAIM else f"no claim ({conclusion})"
