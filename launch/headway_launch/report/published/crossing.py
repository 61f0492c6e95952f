"""The section that sets a study of the crossing beside its paper's figures and beside human drivers."""

from pathlib import Path
from typing import TYPE_CHECKING

import pandas as pd

from headway_launch.report.parts import MISSING, Part, Section, Table, with_interval
from headway_launch.report.published.episodes import (
    MetricColumn,
    env_of,
    learner_figures,
    rule_figures,
    seeds_of,
    tasks_of,
    written,
)
from headway_launch.report.study_data import StudyData
from headway_launch.runner.comparison import SEEDS_FOR_A_CLAIM

if TYPE_CHECKING:
    from headway.stats import Interval

ENVIRONMENT = "intersection"
HUMANS = "human"
"""The rule by which SUMO drives all vehicles, with right of way."""
FIGURES = (
    MetricColumn("paper_return", "reward (their sum)", 0),
    MetricColumn("sumo_steps", "steps", 0),
    MetricColumn("inflow_vph", "inflow, veh/h", 0),
    MetricColumn("outflow_vph", "outflow, veh/h", 0),
    MetricColumn("efficiency", "efficiency", 3),
    MetricColumn("collisions", "collisions", 2),
    MetricColumn("speed", "speed, m/s", 2),
    MetricColumn("fuel_gal_s", "fuel, gal/s", 6),
    MetricColumn("vehicles", "vehicles", 1),
    MetricColumn("speed_av", "AVs' speed, m/s", 2),
    MetricColumn("acceleration_av", "AVs' acceleration, m/s²", 2),
    MetricColumn("hardest_braking_av", "AVs' hardest braking, m/s²", 1),
    MetricColumn("fairness_jain", "fairness", 3),
)
PUBLISHED_NAMES = {"ippo": "PPO", "a3c": "A3C", "ddpg": "DDPG"}
COMPARED = (FIGURES[3], FIGURES[5])
"""Of which learners are set against human drivers."""


def crossing_figures() -> pd.DataFrame:
    """By algorithm, what the paper prints, in the units of the environment's metrics; NaN for what it does
    not."""
    path = Path(__file__).with_name("crossing_table.csv")
    return pd.read_csv(path, comment="#").set_index("algorithm")


def crossing_section(data: StudyData) -> Section | None:
    """The paper's table and ours, and each learner minus human drivers; None for other environments."""
    tasks = tasks_of(data, ENVIRONMENT)
    if not tasks:
        return None
    body: list[Part] = [
        "The paper's figures of one run of each algorithm, and ours in the same units: means over an "
        "episode of the last evaluation, mean ± standard deviation over seeds."
    ]
    for place, task in enumerate(tasks):
        number = f"_{place + 1}" if len(tasks) > 1 else ""
        body += [_beside(data, task, number), *_against_humans(data, task, number)]
    return Section("crossing", "Beside the published crossing", [*body, *_not_comparable(data, tasks)])


def _beside(data: StudyData, task: str, number: str) -> Table:
    published = crossing_figures()
    learners, rules = learner_figures(data, task, FIGURES), rule_figures(data, task, FIGURES)
    trained = [name for name in published.index if (learners["algorithm"] == name).any()]
    theirs = published.loc[trained].rename(index=lambda name: f"published: {PUBLISHED_NAMES[name]}")
    rows = [
        [str(name), seeds_of(row), *written(row.reindex([each.metric for each in FIGURES]), FIGURES)]
        for name, row in theirs.iterrows()
    ]
    rows += [[str(name), seeds_of(row), *written(row, FIGURES)] for name, row in learners.iterrows()]
    first_rule = len(rows)
    rows += [[str(name), MISSING, *written(row, FIGURES)] for name, row in rules.iterrows()]
    return Table(
        f"crossing{number}",
        f"The paper's figures, ours and the rules'{data.where(task)}. Efficiency is outflow over inflow, "
        "but not in the published rows, whose figures do not fit each other; DDPG's inflow there is derived "
        "from the two. Fairness is Jain's index of the times spent by approach, 1 where they are equal.",
        ["controller", "seeds", *(each.heading for each in FIGURES)],
        rows,
        pd.concat([theirs, learners, rules]).rename_axis("controller").reset_index(),
        emphasised=frozenset(range(first_rule, len(rows))),
    )


def _against_humans(data: StudyData, task: str, number: str) -> list[Part]:
    """Each learner's outflow and collisions minus human drivers', day by day."""
    of_rule = data.rules[(data.rules["task"] == task) & (data.rules["rule"] == HUMANS)]
    if of_rule.empty:
        return [
            f"The rule `{HUMANS}` was not played{data.where(task)}: there is no baseline of human drivers."
        ]
    humans = of_rule.set_index("episode_seed")
    rows, exact = [], []
    for name, members in data.on(task).items():
        found = {
            each.metric: data.paired(
                task, data.by_seed(task, name, each.metric), humans[each.metric]
            ).interval
            for each in COMPARED
            if each.metric in humans
        }
        known = {metric: interval for metric, interval in found.items() if interval is not None}
        shown = [_shown(known.get(each.metric)) for each in COMPARED]
        rows.append([name, str(len(members)), *shown, _reading(known, len(members))])
        ends = {
            f"{metric}{part}": value
            for metric, against in known.items()
            for part, value in (("", against.estimate), ("_low", against.low), ("_high", against.high))
        }
        exact.append({"controller": name, "seeds": len(members), **ends})
    return [
        Table(
            f"against_humans{number}",
            f"Learners minus human drivers with right of way (rule `{HUMANS}`){data.where(task)} on the same "
            "days, with 95% intervals by Student's t.",
            ["controller", "seeds", *(each.heading for each in COMPARED), "reading"],
            rows,
            pd.DataFrame(exact),
            words=frozenset({0, 2 + len(COMPARED)}),
        )
    ]


def _shown(against: "Interval | None") -> str:
    if against is None:
        return MISSING
    return with_interval(against.estimate, against.low, against.high, sign=True)


def _reading(found: "dict[str, Interval]", seeds: int) -> str:
    """Whether more vehicles leave, and whether more crash."""
    if len(found) < len(COMPARED):
        return MISSING
    flow, crashes = found["outflow_vph"], found["collisions"]
    said = ", ".join(
        f"more {verb}" if change.low > 0 else f"fewer {verb}" if change.high < 0 else f"{what} not told apart"
        for change, verb, what in ((flow, "leave", "outflow"), (crashes, "crash", "collisions"))
    )
    return said if seeds >= SEEDS_FOR_A_CLAIM else f"no claim ({said})"


def _not_comparable(data: StudyData, tasks: list[str]) -> list[Part]:
    said: list[Part] = [
        "What cannot be compared. The paper gives one run of each algorithm, without seeds or intervals; "
        "peaks over training stand beside means. Its reward is summed over agents and grows with "
        "congestion, as more vehicles are there to be paid; its A3C reports an inflow above what its demand "
        "can send; of collisions it prints two figures for A3C. The share of automated vehicles is not "
        "stated: half, here. Its baseline of 50 runs of human drivers is mentioned and not printed: ours is "
        "the rule in the table.",
        "What it shows. A policy that was never trained and draws accelerations by chance comes close to the "
        "paper's row of PPO (`python -m benchmarks crossing`), so that row is no evidence of "
        "learning.",
    ]
    if any(env_of(data, task)["args"]["reward"]["kind"] != "paper" for task in tasks):
        said.append(
            "Where the environment is not the paper's (`env=intersection`), episodes go on after a collision "
            "and drivers keep to the right of way: compare those rows with the rules, not with the paper."
        )
    return said
