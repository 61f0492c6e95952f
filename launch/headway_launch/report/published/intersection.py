"""Comparison of an intersection study with the published results and with human drivers."""

from typing import TYPE_CHECKING

import pandas as pd

from headway.stats.comparison import SEEDS_FOR_A_CLAIM
from headway_launch.console.number_formats import MISSING, with_interval
from headway_launch.report.elements import Part, Section, Table
from headway_launch.report.published.episode_metrics import (
    MetricColumn,
    env_of,
    formatted_row,
    interval_columns,
    learner_metrics,
    published_results,
    published_values,
    rule_metrics,
    seeds_of,
    tasks_of,
)
from headway_launch.report.study_data import StudyData

if TYPE_CHECKING:
    from headway.stats.samples import Interval

ENVIRONMENT = "intersection"
HUMANS = "human"
"""Rule under which SUMO drives all vehicles with right of way."""
COLUMNS = (
    MetricColumn("paper_return", "reward (sum over agents)", 0),
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
COMPARED = (COLUMNS[3], COLUMNS[5])
"""Metrics in which learners are compared with human drivers."""


def intersection_section(data: StudyData) -> Section | None:
    """Compare learners and rules with the paper's table, and each learner with human drivers.

    None for studies of other environments.
    """
    tasks = tasks_of(data, ENVIRONMENT)
    if not tasks:
        return None
    body: list[Part] = [
        "The paper's results (one run per algorithm) and ours in the same units: means per episode of the "
        "last evaluation, mean ± standard deviation over seeds."
    ]
    for place, task in enumerate(tasks):
        number = f"_{place + 1}" if len(tasks) > 1 else ""
        body += [_comparison(data, task, number), *_against_humans(data, task, number)]
    body += published_results(ENVIRONMENT).caveats
    if any(env_of(data, task)["args"]["reward"]["kind"] != "paper" for task in tasks):
        body.append(
            "In environments that differ from the paper's (`env=intersection`), episodes continue after a "
            "collision and human drivers respect the right of way: compare those rows with the rules, not "
            "with the paper."
        )
    return Section("crossing", "Comparison with the published intersection results", body)


def _comparison(data: StudyData, task: str, number: str) -> Table:
    labels = {algorithm: result.label for algorithm, result in published_results(ENVIRONMENT).results.items()}
    published = published_values(ENVIRONMENT)
    learners, rules = learner_metrics(data, task, COLUMNS), rule_metrics(data, task, COLUMNS)
    trained = [name for name in published.index if (learners["algorithm"] == name).any()]
    theirs = published.loc[trained].rename(index=lambda name: f"published: {labels[name]}")
    rows = [
        [str(name), seeds_of(row), *formatted_row(row.reindex([each.metric for each in COLUMNS]), COLUMNS)]
        for name, row in theirs.iterrows()
    ]
    rows += [[str(name), seeds_of(row), *formatted_row(row, COLUMNS)] for name, row in learners.iterrows()]
    first_rule = len(rows)
    rows += [[str(name), MISSING, *formatted_row(row, COLUMNS)] for name, row in rules.iterrows()]
    return Table(
        f"crossing{number}",
        f"Published results, learners and rules{data.where(task)}. Efficiency is outflow over inflow except "
        "in the published rows, whose values are inconsistent with each other; DDPG's published inflow is "
        "derived from the other two. Fairness is Jain's index of the time spent by approach, 1 if all are "
        "equal.",
        ["controller", "seeds", *(each.heading for each in COLUMNS)],
        rows,
        pd.concat([theirs, learners, rules]).rename_axis("controller").reset_index(),
        emphasised=frozenset(range(first_rule, len(rows))),
    )


def _against_humans(data: StudyData, task: str, number: str) -> list[Part]:
    """Return the table of each learner's outflow and collisions minus human drivers', paired by episode."""
    of_rule = data.of_rule(task, HUMANS)
    if of_rule.empty:
        return [f"There is no baseline of human drivers{data.where(task)}: the rule `{HUMANS}` was not run."]
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
        rows.append([name, str(len(members)), *shown, _conclusion(known, len(members))])
        exact.append({"controller": name, "seeds": len(members), **interval_columns(found)})
    return [
        Table(
            f"against_humans{number}",
            f"Learners minus human drivers with right of way (rule `{HUMANS}`){data.where(task)} on the same "
            "episodes, with 95% intervals by Student's t.",
            ["controller", "seeds", *(each.heading for each in COMPARED), "conclusion"],
            rows,
            pd.DataFrame(exact),
            words=frozenset({0, 2 + len(COMPARED)}),
        )
    ]


def _shown(against: "Interval | None") -> str:
    if against is None:
        return MISSING
    return with_interval(against.estimate, against.low, against.high, sign="+")


def _conclusion(found: "dict[str, Interval]", seeds: int) -> str:
    """State whether outflow and collisions are higher or lower than with human drivers."""
    if len(found) < len(COMPARED):
        return MISSING
    outflow, collisions = found["outflow_vph"], found["collisions"]
    conclusion = ", ".join(
        f"more {name}"
        if change.low > 0
        else f"{less} {name}"
        if change.high < 0
        else f"{name}: no difference shown"
        for change, name, less in ((outflow, "outflow", "less"), (collisions, "collisions", "fewer"))
    )
    return conclusion if seeds >= SEEDS_FOR_A_CLAIM else f"no claim ({conclusion})"
