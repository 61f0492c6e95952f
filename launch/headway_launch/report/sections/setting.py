"""Section on results by the value of a swept setting, such as the share of automated vehicles."""

import json
import math
from collections.abc import Mapping, Sequence
from typing import Any

import pandas as pd

from headway.stats import frames, plots
from headway_launch.console.number_formats import MISSING, formatted, with_interval
from headway_launch.experiments.experiment import wrappers_of
from headway_launch.experiments.parameters import flat
from headway_launch.report.elements import Part, Picture, Section, Table
from headway_launch.report.sections.rewards import exact_against
from headway_launch.report.study_data import StudyData
from headway_launch.studies.runs import configuration

FEWEST_VALUES = 3
"""Number of values of a setting from which results by its value are shown."""
_ARGS = "args."


def setting_section(data: StudyData) -> Section | None:
    """Return the section with the results by the value of each number in `env.args` that was swept.

    None if none has at least `FEWEST_VALUES` values, other settings being equal, or if the last evaluations
    lack the metric.
    """
    body: list[Part] = []
    found = {key: (groups, _points(data, groups)) for key, groups in swept_settings(data).items()}
    found = {key: (groups, points) for key, (groups, points) in found.items() if len(points)}
    for place, (key, (all_groups, points)) in enumerate(found.items()):
        groups = {group: all_groups[group] for group in dict.fromkeys(points["group"])}
        suffix = f"_{place + 1}" if len(found) > 1 else ""
        dashed = "; dashed: the rules on the same episodes" if (points["runs"] == 0).any() else ""
        picture = plots.by_setting(points, key, data.metric_with_unit, data.styles, data.sign)
        caption = (
            f"Mean {data.metric_label} in the last {data.mode} evaluation by {key}. Learners: with the 95% "
            f"interval over seeds by Student's t, from {plots.FEWEST_SEEDS} seeds on{dashed}."
        )
        body.append(Picture(f"by_setting{suffix}", caption, picture))
        for number, (group, tasks) in enumerate(groups.items()):
            name = f"by_setting{suffix}{f'_{number + 1}' if len(groups) > 1 else ''}"
            of_group = points[points["group"] == group].drop(columns="group")
            body.append(_table(data, of_group, key, group, tasks, name))
    return Section("by_setting", f"Results by {', '.join(found)}", body) if body else None


def swept_settings(data: StudyData) -> dict[str, dict[str, dict[float, str]]]:
    """Return the keys that were swept, and per group of tasks with equal other settings each value's task.

    The first key is that whose groups have the most tasks, the next is that of the remaining tasks. A group
    has at least `FEWEST_VALUES`.
    """
    settings = {task: _settings(data, task) for task in data.tasks}
    found: dict[str, dict[str, dict[float, str]]] = {}
    while True:
        keys = dict.fromkeys(key for own in settings.values() for key in own if key.startswith(_ARGS))
        by_key = {key: _groups(settings, key) for key in keys}
        swept = max(by_key, key=lambda key: sum(map(len, by_key[key].values())), default="")
        groups = by_key.get(swept)
        if not groups:
            return found
        names = _names([json.loads(group) for group in groups])
        found[f"env.{swept}"] = dict(zip(names, groups.values(), strict=True))
        for tasks in groups.values():
            for task in tasks.values():
                del settings[task]


def _settings(data: StudyData, task: str) -> dict[str, Any]:
    """Return the settings that define a task, by dotted key without `env.`."""
    members = next(iter(data.on(task).values()))
    env = configuration(members[0].directory)["env"]
    settings = dict(flat({name: value for name, value in env.items() if name != "training_args"}))
    return {**settings, "wrappers": wrappers_of(env, only_rewards=False), "file_digest": None}


def _groups(settings: Mapping[str, Mapping[str, Any]], key: str) -> dict[str, dict[float, str]]:
    """Return the tasks by the number `key`, grouped by their other settings as JSON."""
    found: dict[str, dict[float, str]] = {}
    for task, own in settings.items():
        value = own.get(key)
        if isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value):
            others = {name: other for name, other in own.items() if name != key}
            found.setdefault(json.dumps(others, sort_keys=True), {})[value] = task
    return {
        others: dict(sorted(tasks.items())) for others, tasks in found.items() if len(tasks) >= FEWEST_VALUES
    }


def _names(groups: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return a name for the settings of each group: the environment and the settings that differ."""
    several = len({group["id"] for group in groups}) > 1
    names = []
    for group in groups:
        alike = [other for other in groups if other["id"] == group["id"]]
        differing = [key for key in group if any(other.get(key) != group[key] for other in alike)]
        shown = [f"{key.removeprefix(_ARGS)}={group[key]}" for key in differing]
        names.append(", ".join([group["id"]] * several + shown))
    return names


def _points(data: StudyData, groups: Mapping[str, Mapping[float, str]]) -> pd.DataFrame:
    """Return one row per group, value and controller; none for groups whose learners all lack the metric.

    Columns: `group`, `controller`, `setting` (the value), `runs` (0 for a rule), `mean`, `low`, `high`, and
    for learners those of `exact_against`.
    """
    found: list[dict[str, Any]] = []
    for group, tasks in groups.items():
        rows: list[dict[str, Any]] = []
        for value, task in tasks.items():
            place: dict[str, Any] = {"group": group, "setting": value}
            for controller in data.on(task):
                of_seeds = data.by_seed(task, controller, data.column).mean(axis="columns").dropna()
                labels = {"task": task, "controller": controller, "env_steps": 0}
                means = frames.mean_curves(pd.DataFrame({"value": of_seeds, **labels}).reset_index())
                exact = exact_against(data.against_best_rule(task, controller))
                rows += [
                    place | {str(name): each for name, each in row.items()} | exact
                    for row in means.to_dict("records")
                ]
            for rule in data.ranked_rules(task):
                mean = float(data.by_episode(task, rule).mean())
                rows.append({**place, "controller": f"rule {rule}", "runs": 0, "mean": mean})
        if any(row["runs"] for row in rows):
            found += rows
    return pd.DataFrame(found).drop(columns=["task", "env_steps"], errors="ignore")


def _table(
    data: StudyData, points: pd.DataFrame, key: str, group: str, tasks: Mapping[float, str], name: str
) -> Table:
    means = {(row["controller"], row["setting"]): row["mean"] for row in points.to_dict("records")}
    controllers = dict.fromkeys(points["controller"])
    learners = [each for each in data.controllers if each in controllers]
    rules = [each for each in data.styles if each in controllers and each not in learners]
    headings = [key.removeprefix(f"env.{_ARGS}")]
    for learner in learners:
        headings += [learner, f"{learner} minus best rule [95%]"] if rules else [learner]
    rows = []
    for value, task in tasks.items():
        cells = [f"{value:g}"]
        for learner in learners:
            cells.append(formatted(means.get((learner, value))))
            if rules:
                known = (learner, value) in means
                found = data.against_best_rule(task, learner).interval if known else None
                cells.append(with_interval(found.estimate, found.low, found.high, "+") if found else MISSING)
        rows.append([*cells, *(formatted(means.get((rule, value))) for rule in rules)])
    differences = (
        " Differences are from the rule that is best at the value, paired by episode, with 95% intervals by "
        "Student's t, over seeds and episodes or, for one seed, over episodes."
    )
    where = f" ({group})" if group else ""
    return Table(
        name,
        f"Mean {data.metric_label} in the last {data.mode} evaluation by {key}{where}."
        f"{differences if rules else ''}",
        [*headings, *rules],
        rows,
        points,
    )
