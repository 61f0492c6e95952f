"""Sections on the way there and what came of it: curves, all environments together, figures of the days."""

import pandas as pd

from headway.stats import frames, plots
from headway_launch.report.parts import Part, Picture, Section, Table, figure, with_deviation, with_interval
from headway_launch.report.study_data import StudyData

_COMPONENT = "reward_"


def curves_section(data: StudyData) -> Section:
    """Learning curves, and sample efficiency on the common scale."""
    means = frames.mean_curves(data.curves)
    label = f"{data.mode}: {data.column.replace('_', ' ')}"
    body: list[Part] = [
        Picture(
            "learning_curves",
            f"Learning curves: mean of the {data.mode} evaluation over seeds with the 95% interval of that "
            "mean by Student's t; dashed, the rules on the same days.",
            plots.learning_curves(
                means, data.rules_beside_curves, label, data.styles, low=data.low, sign=data.sign
            ),
        )
    ]
    curves, sign = data.curves.assign(value=data.sign * data.curves["value"]), 1
    if set(data.tasks) <= set(data.scale):
        curves = frames.normalised_by_rules(curves, "value", data.scale)
        label = "normalised score"
        scale = "scores on the scale on which random play is 0 and the best rule 1"
    elif len(data.tasks) == 1:
        curves, sign, scale = data.curves, data.sign, f"{data.what} as it is"
    else:
        body.append(f"Sample efficiency over all environments is left out: {_why_no_scale(data)}.")
        return Section("curves", "Learning curves", body)
    found = frames.efficiency(curves[curves["controller"].isin(data.everywhere)])
    left_out = [name for name in data.everywhere if name not in set(found["controller"])]
    if len(found):
        body.append(
            Picture(
                "sample_efficiency",
                "Sample efficiency: interquartile mean over "
                f"seeds{' and environments' if len(data.tasks) > 1 else ''} at each number of steps "
                f"({scale}), with 95% intervals by the stratified bootstrap. {data.narrow}".strip(),
                plots.learning_curves(found, {}, f"IQM of {label}", data.styles, sign=sign),
            )
        )
    if left_out:
        body.append(
            f"Without a sample-efficiency curve, as their runs share no steps: {', '.join(left_out)}."
        )
    return Section("curves", "Learning curves", body)


def across_environments(data: StudyData) -> Section | None:
    """Scores of all environments put together; None where there is only one."""
    if len(data.tasks) == 1:
        return None
    title = "Across environments"
    missing = _why_no_scale(data)
    if missing:
        return Section("across", title, [f"Scores cannot be put together: {missing}."])
    elsewhere = [name for name in data.controllers if name not in data.everywhere]
    body: list[Part] = []
    if elsewhere:
        body.append(f"Not trained on every environment, and so left out here: {', '.join(elsewhere)}.")
    if not data.everywhere:
        return Section("across", title, body)
    scores = data.scores[data.scores["controller"].isin(data.everywhere)]
    scaled = frames.normalised_by_rules(scores.assign(score=data.sign * scores["score"]), "score", data.scale)
    found = frames.summary(scaled)
    rows = [
        [
            str(name),
            str(int(row["runs"])),
            with_deviation(row["mean"], row["std"]),
            with_interval(row["iqm"], row["iqm_low"], row["iqm_high"]),
        ]
        for name, row in found.iterrows()
    ]
    profiles = plots.performance_profiles(frames.profiles(scaled), "normalised final score", data.styles)
    body += [
        Table(
            "across_environments",
            f"Normalised final scores over {len(data.tasks)} environments: 0 is random play, 1 the best "
            "rule.",
            ["controller", "runs", "mean ± std", "IQM [95%]"],
            rows,
            found.reset_index(),
        ),
        Picture("profiles_across", "Performance profiles over all environments.", profiles),
    ]
    return Section("across", title, body)


def figures_section(data: StudyData) -> Section:
    """All figures of the last evaluation's days, and the parts of the reward."""
    body: list[Part] = [
        f"Means over the days of the last {data.mode} evaluation, of learners over their seeds too."
    ]
    parted = False
    for place, task in enumerate(data.tasks):
        names = list(data.on(task))
        rules = data.ranked_rules(task)
        columns = {name: data.days[_is(data, task, name)] for name in names}
        played = data.rules[data.rules["task"] == task]
        columns |= {f"rule {rule}": played[played["rule"] == rule] for rule in rules}
        means = pd.DataFrame(
            {
                label: {metric: _mean(days, metric) for metric in data.metrics}
                for label, days in columns.items()
            }
        ).dropna(how="all")
        where = data.where(task)
        body.append(
            Table(
                f"figures{data.numbered(place)}",
                f"Figures of a day{where}.",
                ["figure of a day", *columns],
                [
                    [str(metric), *map(figure, row)]
                    for metric, row in zip(means.index, means.to_numpy(), strict=True)
                ],
                means.rename_axis("figure").reset_index(),
            )
        )
        components = means[[str(name).startswith(_COMPONENT) for name in means.index]]
        if len(components):
            parted = True
            picture = plots.reward_components(components.T)
            body.append(
                Picture(
                    f"components{data.numbered(place)}",
                    f"The parts of the reward{where} as the episodes' figures `{_COMPONENT}...` give them, "
                    "each on its own scale (`headway list metrics` says whether weighted): paid to the right "
                    "of 0, charged to the left. Parts that are 0 for all are left out.",
                    picture,
                )
            )
    if not parted:
        body.append(
            "The reward is not shown by component: the episodes have no figures named `reward_...` that "
            "would part it."
        )
    return Section("figures", "Figures of the evaluation days", body)


def _is(data: StudyData, task: str, controller: str) -> "pd.Series[bool]":
    return (data.days["task"] == task) & (data.days["controller"] == controller)


def _mean(days: pd.DataFrame, metric: str) -> float:
    return float(days[metric].mean()) if metric in days else float("nan")


def _why_no_scale(data: StudyData) -> str:
    """Why scores of different environments cannot be normalised; empty where they can."""
    missing = [task for task in data.tasks if task not in data.scale]
    if not missing:
        return ""
    return (
        f"{', '.join(missing)} {'has' if len(missing) == 1 else 'have'} not both random play (0) and a rule "
        "better than it (1) on the days of the curves; add `random` to `evaluation.rules`"
    )
