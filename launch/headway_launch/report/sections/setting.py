"""Section on results by the value of a swept setting, such as the share of automated vehicles."""

import json
from collections.abc import Mapping
from typing import Any

import pandas as pd

from headway.stats import frames, plots
from headway_launch.console.number_formats import MISSING, formatted, with_interval
from headway_launch.experiments.parameters import flat
from headway_launch.report.elements import Part, Picture, Section, Table
from headway_launch.report.study_data import StudyData
from headway_launch.studies.runs import configuration

FEWEST_VALUES = 3
"""Number of values of a setting from which a table and a picture by its value are shown."""


def setting_section(data: StudyData) -> Section | None:
    """Return the section with the results by the value of the number that most tasks differ in.

    None if no number in `env.args` has at least `FEWEST_VALUES` values.
    """
    swept = _swept(data)
    if swept is None:
        return None
    key, groups = swept
    points = pd.concat([_points(data, group, tasks) for group, tasks in groups.items()], ignore_index=True)
    body: list[Part] = [
        Picture(
            "by_setting",
            f"Mean {data.metric_label} in the last {data.mode} evaluation by {key}. Learners: with the 95% "
            f"interval over seeds by Student's t, from {plots.FEWEST_SEEDS} seeds on; dashed: the rules on "
            "the same episodes.",
            plots.by_setting(points, key, data.metric_with_unit, data.styles),
        )
    ]
    for place, (group, tasks) in enumerate(groups.items()):
        suffix = f"_{place + 1}" if len(groups) > 1 else ""
        body.append(_table(data, points, key, group, tasks, f"by_setting{suffix}"))
    return Section("by_setting", f"Results by {key}", body)


def _swept(data: StudyData) -> tuple[str, dict[str, dict[float, str]]] | None:
    """Return the key in `env.args` whose numbers the tasks differ in most, and the tasks by their value.

    The tasks are grouped by their other settings, which differ between groups.
    """
    settings = {task: _settings(data, task) for task in data.tasks}
    numbers: dict[str, set[float]] = {}
    for own in settings.values():
        for key, value in own.items():
            if isinstance(value, int | float) and not isinstance(value, bool):
                numbers.setdefault(key, set()).add(value)
    swept = max(numbers, key=lambda key: len(numbers[key]), default="")
    if len(numbers.get(swept, ())) < FEWEST_VALUES:
        return None
    differing = [
        key
        for key in dict.fromkeys(key for own in settings.values() for key in own)
        if key != swept and len({json.dumps(own.get(key)) for own in settings.values()}) > 1
    ]
    groups: dict[str, dict[float, str]] = {}
    for task, own in settings.items():
        if swept in own:
            group = ", ".join(f"{key}={own[key]}" for key in differing if key in own)
            groups.setdefault(group, {})[own[swept]] = task
    complete = {
        group: dict(sorted(tasks.items())) for group, tasks in groups.items() if len(tasks) >= FEWEST_VALUES
    }
    return (swept, complete) if complete else None


def _settings(data: StudyData, task: str) -> Mapping[str, Any]:
    """Return the settings of a task's environment, by dotted key."""
    members = next(iter(data.on(task).values()))
    env = configuration(members[0].directory)["env"]
    return {"env": env["id"], **dict(flat({"env": {"args": env["args"]}}))}


def _points(data: StudyData, group: str, tasks: Mapping[float, str]) -> pd.DataFrame:
    """Return one row per value and controller.

    Columns: `group`, `controller`, `setting` (the value), `runs` (0 for a rule), `mean`, `low` and `high`.
    """
    found = []
    for value, task in tasks.items():
        of_seeds = data.episodes[data.episodes["task"] == task].groupby(["task", "controller", "run_id"])
        learned = of_seeds[data.column].mean().rename("value").reset_index()
        found.append(frames.mean_curves(learned.assign(env_steps=value)))
        means = data.rules[data.rules["task"] == task].groupby("rule")[data.column].mean()
        names = [f"rule {rule}" for rule in means.index]
        found.append(
            pd.DataFrame({"controller": names, "runs": 0, "env_steps": value, "mean": means.to_numpy()})
        )
    points = pd.concat(found, ignore_index=True).drop(columns="task").assign(group=group)
    return points.rename(columns={"env_steps": "setting"})


def _table(
    data: StudyData, points: pd.DataFrame, key: str, group: str, tasks: Mapping[float, str], name: str
) -> Table:
    of_group = points[points["group"] == group]
    means: dict[str, dict[float, float]] = {}
    for row in of_group.to_dict("records"):
        means.setdefault(str(row["controller"]), {})[row["setting"]] = row["mean"]
    learners = [each for each in data.controllers if each in means]
    rules = [each for each in data.styles if each in means and each not in learners]
    headings = [key.removeprefix("env.args.")]
    for learner in learners:
        headings += [learner, f"{learner} minus best rule [95%]"]
    rows = []
    for value, task in tasks.items():
        cells = [formatted(value)]
        for learner in learners:
            found = data.against_best_rule(task, learner).interval if learner in data.on(task) else None
            difference = with_interval(found.estimate, found.low, found.high, sign="+") if found else MISSING
            cells += [formatted(means[learner].get(value)), difference]
        rows.append([*cells, *(formatted(means[rule].get(value)) for rule in rules)])
    where = f", {group}" if group else ""
    return Table(
        name,
        f"Mean {data.metric_label} in the last {data.mode} evaluation by {key}{where}. Differences are from "
        "the rule that is best at the value, paired by episode, with 95% intervals by Student's t over seeds "
        "and episodes.",
        [*headings, *rules],
        rows,
        of_group.drop(columns="group"),
    )
