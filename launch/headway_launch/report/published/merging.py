"""The section that answers the merging study's question: who scales from one ramp lane to two."""

import math
from typing import TYPE_CHECKING, Any, Final

import pandas as pd

from headway.stats import difference_of_means
from headway_launch.report.parts import MISSING, Part, Section, Table
from headway_launch.report.published.episodes import (
    MetricColumn,
    env_of,
    learner_figures,
    mean_by_seed,
    rule_figures,
    seeds_of,
    tasks_of,
    written,
)
from headway_launch.report.study_data import StudyData
from headway_launch.runner.comparison import SEEDS_FOR_A_CLAIM

if TYPE_CHECKING:
    from headway.stats import Interval

ONE_LANE, TWO_LANES = "merge", "merge_two_lane"
PUBLISHED: Final[dict[tuple[str, str], str]] = {
    (ONE_LANE, "mappo"): "0 to 70, mostly 20 to 60",
    (ONE_LANE, "maacktr"): "40 to 60",
    (ONE_LANE, "madqn"): "-100 to 50",
    (TWO_LANES, "mappo"): "25 to 50, at the end about 75",
    (TWO_LANES, "maacktr"): "10 to 20",
    (TWO_LANES, "madqn"): "-100 to 50",
}
"""Rewards as the study's text tells its curves, which it prints without a table."""
PUBLISHED_ANSWER: Final[dict[str, str]] = {
    "mappo": "scales",
    "maacktr": "does not",
    "madqn": "does not learn",
}
FIGURES = (
    MetricColumn("reward", "reward", 1),
    MetricColumn("crash_rate", "crashes", 3),
    MetricColumn("merge_rate", "merged", 3),
    MetricColumn("mean_speed_ms", "speed, m/s", 2),
    MetricColumn("interventions", "interventions", 1),
)

CHANGES = FIGURES[:4]


def merging_section(data: StudyData) -> Section | None:
    """Rewards, crashes, merges and speeds beside the published ranges, and the change from one ramp lane to
    two; None for studies of other environments."""
    tasks = tasks_of(data, ONE_LANE, TWO_LANES)
    if not tasks:
        return None
    body: list[Part] = [
        "The study prints curves and no table; the ranges below are those in which its text sees the rewards "
        "of evaluation, over 10,000 episodes at density 2. Its answer: MAPPO scales to two ramp lanes, "
        "MAACKTR gets worse, MADQN learns on neither.",
        _beside(data, tasks),
    ]
    pairs = _pairs(data, tasks)
    for place, (one, two) in enumerate(pairs):
        body += _scaling(data, one, two, f"_{place + 1}" if len(pairs) > 1 else "")
    if not pairs:
        body.append(
            f"How an algorithm scales cannot be told from these runs: that takes the same setting on "
            f"`{ONE_LANE}` and on `{TWO_LANES}`."
        )
    return Section("merging", "Beside the merging study", [*body, *_why_they_differ()])


def _beside(data: StudyData, tasks: list[str]) -> Table:
    rows: list[list[str]] = []
    exact: list[dict[str, Any]] = []
    rules: set[int] = set()
    for task in tasks:
        environment = str(env_of(data, task)["id"])
        for name, row in learner_figures(data, task, FIGURES).iterrows():
            said = PUBLISHED.get((environment, str(row["algorithm"])), MISSING)
            rows.append([task, str(name), seeds_of(row), said, *written(row, FIGURES)])
            exact.append({"environment": task, "controller": name, "published_reward": said, **row})
        for name, row in rule_figures(data, task, FIGURES).iterrows():
            rules.add(len(rows))
            rows.append([task, str(name), MISSING, MISSING, *written(row, FIGURES)])
            exact.append({"environment": task, "controller": name, **row})
    return Table(
        "merging",
        "An episode's reward (the sum over its steps of the vehicles' mean), the share of episodes with a "
        "crash, the share of CAVs past the ramp's end on the highway, their mean speed, and actions that "
        "the supervisor replaced: the last evaluation, mean ± standard deviation over seeds. The "
        "published runs had the supervisor on.",
        ["environment", "controller", "seeds", "published: reward", *(each.heading for each in FIGURES)],
        rows,
        pd.DataFrame(exact),
        words=frozenset({0, 1, 3}),
        emphasised=frozenset(rules),
    )


def _pairs(data: StudyData, tasks: list[str]) -> list[tuple[str, str]]:
    """Tasks that differ in the number of ramp lanes alone."""

    def traffic(task: str) -> dict[str, Any]:
        found: dict[str, Any] = env_of(data, task)["args"]
        return found

    of = {environment: tasks_of(data, environment) for environment in (ONE_LANE, TWO_LANES)}
    return [(one, two) for one in of[ONE_LANE] for two in of[TWO_LANES] if traffic(one) == traffic(two)]


def _scaling(data: StudyData, one: str, two: str, number: str) -> list[Part]:
    """What the second ramp lane costs each learner."""
    both = [name for name in data.on(one) if name in data.on(two)]
    rows, exact = [], []
    for name in both:
        members = data.on(one)[name]
        seeds = min(len(members), len(data.on(two)[name]))
        changes = {each.metric: _change(data, one, two, name, each.metric) for each in CHANGES}
        said = PUBLISHED_ANSWER.get(members[0].algorithm, MISSING)
        shown = [_shown(changes[each.metric], each.decimals) for each in CHANGES]
        rows.append([name, str(seeds), *shown, said, _reading(changes["reward"], seeds)])
        exact.append({"controller": name, "seeds": seeds, **_whole(changes)})
    if not rows:
        return [f"No learner was trained on both {one} and {two}."]
    return [
        Table(
            f"scaling{number}",
            f"{two} minus {one}: the difference of the means over seeds, with its 95% interval by Welch's t.",
            ["controller", "seeds", *(each.heading for each in CHANGES), "published", "here"],
            rows,
            pd.DataFrame(exact),
            words=frozenset({0, 2 + len(CHANGES), 3 + len(CHANGES)}),
        )
    ]


def _change(data: StudyData, one: str, two: str, name: str, metric: str) -> "Interval | None":
    """None where a metric was not logged, or there is one seed."""
    of_one, of_two = (mean_by_seed(data, task, name, metric) for task in (one, two))
    if min(len(of_one), len(of_two)) < 2:
        return None
    return difference_of_means(of_two, of_one)


def _shown(change: "Interval | None", decimals: int) -> str:
    if change is None:
        return MISSING
    if math.isnan(change.low):
        return f"{change.estimate:+.{decimals}f}"
    return f"{change.estimate:+.{decimals}f} [{change.low:.{decimals}f}, {change.high:.{decimals}f}]"


def _reading(change: "Interval | None", seeds: int) -> str:
    if change is None:
        return MISSING
    reading = "no difference shown"
    if change.excludes_zero:
        reading = "gains" if change.estimate > 0 else "loses"
    return reading if seeds >= SEEDS_FOR_A_CLAIM else f"no claim ({reading})"


def _whole(changes: "dict[str, Interval | None]") -> dict[str, float]:
    return {
        f"{metric}{part}": value
        for metric, change in changes.items()
        if change is not None
        for part, value in (("", change.estimate), ("_low", change.low), ("_high", change.high))
    }


def _why_they_differ() -> list[Part]:
    return [
        "Why figures differ. The published runs had the safety supervisor on, which replaces actions that "
        "are foreseen to end in a collision, and say so nowhere: compare them with runs of "
        "`env.args.supervisor=true`. Their evaluation draws actions and is of three episodes a point, so "
        "that one crash, which costs 200, moves a point by about 70; ours is greedy and of many days kept "
        "apart from training. Crashes are in no published figure.",
        "The published MADQN could not learn: its step counter went back to 0 every 100 steps, so that at "
        "least 98.8% of its actions stayed random, and rewards were multiplied by 20 without any clipping. "
        "Its MAPPO took a critic of state and action for the baseline and the time limit for an end. These "
        "defects are not in ours; `preset=merge_paper` has the hyper-parameters.",
        "The second ramp lane is not published in numbers: ours is parallel to the first, 4 m further out, "
        "and whoever is on it must change lanes twice within 100 m. `merge_as_published` has the older "
        "dynamics and the published protocol.",
    ]
