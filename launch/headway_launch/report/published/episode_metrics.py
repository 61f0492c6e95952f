"""Episode metrics of the last evaluation by controller, and the published results they are compared with."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from headway.contracts import PublishedResults
from headway.registry import env_entry
from headway.stats.samples import Interval
from headway_launch.console.number_formats import MISSING, formatted, with_deviation
from headway_launch.report.study_data import StudyData, mean_of_known
from headway_launch.studies.runs import configuration


@dataclass(frozen=True)
class MetricColumn:
    """A table column that shows an episode metric."""

    metric: str
    heading: str
    decimals: int


def published_results(environment: str) -> PublishedResults:
    """Return the results published for a registered environment, which must have some."""
    published = env_entry(environment).published
    assert published is not None
    found = published.load()
    assert isinstance(found, PublishedResults)
    return found


def published_values(environment: str) -> pd.DataFrame:
    """Return the printed numbers, algorithms x metrics; NaN for numbers that are not printed."""
    results = published_results(environment).results
    values = {algorithm: result.values for algorithm, result in results.items()}
    return pd.DataFrame.from_dict(values, orient="index").rename_axis("algorithm")


def tasks_of(data: StudyData, *environments: str) -> list[str]:
    """Return the study's tasks on these environments."""
    return [task for task in data.tasks if env_of(data, task)["id"] in environments]


def env_of(data: StudyData, task: str) -> dict[str, Any]:
    """Return the configuration `env` of a task, read from its first run."""
    first = next(iter(data.on(task).values()))[0]
    found: dict[str, Any] = configuration(first.directory)["env"]
    return found


def learner_metrics(data: StudyData, task: str, columns: Sequence[MetricColumn]) -> pd.DataFrame:
    """Return one row per learner: `algorithm`, `seeds`, and each metric's mean over seeds and `_std`.

    NaN for metrics that were not logged.
    """
    found = {}
    for name, members in data.on(task).items():
        row: dict[str, Any] = {"algorithm": members[0].algorithm, "seeds": len(members)}
        for each in columns:
            of_cell = mean_of_known(data.by_seed(task, name, each.metric).mean(axis="columns"))
            row |= {each.metric: of_cell.mean, f"{each.metric}_std": of_cell.std}
        found[name] = row
    return pd.DataFrame.from_dict(found, orient="index")


def rule_metrics(data: StudyData, task: str, columns: Sequence[MetricColumn]) -> pd.DataFrame:
    """Return one row per rule, best first: the mean of each metric over episodes."""
    metrics = [each.metric for each in columns]
    of_rules = {rule: data.of_rule(task, rule).reindex(columns=metrics) for rule in data.ranked_rules(task)}
    return pd.DataFrame({f"rule {rule}": episodes.mean() for rule, episodes in of_rules.items()}).T


def formatted_row(row: "pd.Series[Any]", columns: Sequence[MetricColumn]) -> list[str]:
    """Format a row for display: mean ± standard deviation of a learner, the mean of a rule."""
    return [
        with_deviation(float(row[each.metric]), float(row.get(f"{each.metric}_std", np.nan)), each.decimals)
        for each in columns
    ]


def interval_columns(found: Mapping[str, Interval | None]) -> dict[str, float]:
    """Return the exact values of known intervals by column: the metric's name, `..._low` and `..._high`."""
    return {
        f"{metric}{part}": value
        for metric, interval in found.items()
        if interval is not None
        for part, value in (("", interval.estimate), ("_low", interval.low), ("_high", interval.high))
    }


def seeds_of(row: "pd.Series[Any]") -> str:
    """Return the number of seeds of a row, or a dash for a rule."""
    return formatted(float(row["seeds"])) if "seeds" in row else MISSING
