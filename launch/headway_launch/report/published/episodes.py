"""Figures of the last evaluation's episodes by controller, learners and rules alike."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from headway.stats import mean_std
from headway_launch.report.parts import MISSING, figure, with_deviation
from headway_launch.report.study_data import StudyData
from headway_launch.studies.runs import configuration


@dataclass(frozen=True)
class MetricColumn:
    """One column of a table: a metric of the episodes, as it is headed."""

    metric: str
    heading: str
    decimals: int


def tasks_of(data: StudyData, *environments: str) -> list[str]:
    """The study's tasks that are in one of these environments."""
    return [task for task in data.tasks if env_of(data, task)["id"] in environments]


def env_of(data: StudyData, task: str) -> dict[str, Any]:
    """The configuration `env` of a task: of its first run."""
    first = next(iter(data.on(task).values()))[0]
    found: dict[str, Any] = configuration(first.directory)["env"]
    return found


def learner_figures(data: StudyData, task: str, figures: Sequence[MetricColumn]) -> pd.DataFrame:
    """A row a learner: `algorithm`, `seeds`, and of each metric its mean over seeds and `_std`; NaN for what
    was not logged."""
    found = {}
    for name, members in data.on(task).items():
        row: dict[str, Any] = {"algorithm": members[0].algorithm, "seeds": len(members)}
        for each in figures:
            of_seeds = mean_by_seed(data, task, name, each.metric)
            of_cell = mean_std(of_seeds) if len(of_seeds) else None
            row[each.metric] = of_cell.mean if of_cell else float("nan")
            row[f"{each.metric}_std"] = of_cell.std if of_cell else float("nan")
        found[name] = row
    return pd.DataFrame.from_dict(found, orient="index")


def rule_figures(data: StudyData, task: str, figures: Sequence[MetricColumn]) -> pd.DataFrame:
    """A row a rule, the best first: of each metric its mean over days."""
    found = {}
    for rule in data.ranked_rules(task):
        of_rule = data.rules[(data.rules["task"] == task) & (data.rules["rule"] == rule)]
        found[f"rule {rule}"] = {
            each.metric: float(of_rule[each.metric].mean()) if each.metric in of_rule else float("nan")
            for each in figures
        }
    return pd.DataFrame.from_dict(found, orient="index")


def mean_by_seed(data: StudyData, task: str, controller: str, metric: str) -> "np.ndarray[Any, Any]":
    """(seeds,): a learner's means over days; empty where the metric was not logged."""
    values = data.by_seed(task, controller, metric)
    return values.mean(axis="columns").to_numpy() if values.size else np.empty(0)


def written(row: "pd.Series[Any]", figures: Sequence[MetricColumn]) -> list[str]:
    """A row's figures as they are read: mean ± standard deviation of a learner, the mean of a rule."""
    return [
        with_deviation(float(row[each.metric]), float(row.get(f"{each.metric}_std", np.nan)), each.decimals)
        for each in figures
    ]


def seeds_of(row: "pd.Series[Any]") -> str:
    """The number of seeds; a dash for a rule."""
    return figure(float(row["seeds"])) if "seeds" in row else MISSING
