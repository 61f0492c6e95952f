"""Sections on learning curves, on all environments together, and on the metrics of the last evaluation."""

import pandas as pd

from headway.stats import frames, plots
from headway_launch.report.elements import (
    Part,
    Picture,
    Section,
    Table,
    formatted,
    with_deviation,
    with_interval,
)
from headway_launch.report.study_data import StudyData
from headway_launch.studies.runs import rule_phases

_COMPONENT = "reward_"
_STAGES = "; vertical lines: the next stage of training begins"
_RULE_PHASES = "; shaded: the rule of `start.rule` acts"


def curves_section(data: StudyData) -> Section:
    """Return the section with learning curves and sample efficiency."""
    means = frames.mean_curves(data.curves)
    label, phases = f"{data.mode}: {data.readable(data.column)}", rule_phases(data.runs)
    body: list[Part] = [
        Picture(
            "learning_curves",
            f"Learning curves: mean of the {data.mode} evaluation over seeds with the 95% interval of that "
            f"mean by Student's t, from {plots.FEWEST_SEEDS} seeds on (thin lines where many overlap); "
            f"dashed lines: the rules on the same episodes{_STAGES if any(data.stage_ends.values()) else ''}"
            f"{_RULE_PHASES if phases else ''}.",
            plots.learning_curves(
                means,
                data.rules_beside_curves,
                label,
                data.styles,
                low=data.low,
                sign=data.sign,
                stage_ends=data.stage_ends,
                rule_phases=phases,
            ),
        )
    ]
    curves, sign = data.curves.assign(value=data.sign * data.curves["value"]), 1
    if set(data.tasks) <= set(data.scale):
        curves = frames.normalised_by_rules(curves, "value", data.scale)
        label = "normalised score"
        scale = "normalised: the random rule scores 0, the best rule 1"
    elif len(data.tasks) == 1:
        curves, sign, scale = data.curves, data.sign, f"{data.readable(data.column)}, not normalised"
    else:
        body.append(f"Sample efficiency over all environments is omitted: {_missing_scale(data)}.")
        return Section("curves", "Learning curves", body)
    found = frames.efficiency(curves[curves["controller"].isin(data.trained_on_all_tasks)])
    without = [name for name in data.trained_on_all_tasks if name not in set(found["controller"])]
    if len(found):
        body.append(
            Picture(
                "sample_efficiency",
                "Sample efficiency: interquartile mean over "
                f"seeds{' and environments' if len(data.tasks) > 1 else ''} at each number of steps "
                f"({scale}), with 95% intervals by the stratified bootstrap. {data.few_seeds_note}".strip(),
                plots.learning_curves(found, {}, f"IQM of {label}", data.styles, sign=sign),
            )
        )
    if without:
        runs = "its runs" if len(without) == 1 else "the runs of each"
        body.append(
            f"No sample-efficiency curve for {', '.join(without)}: {runs} have no evaluation step in common."
        )
    return Section("curves", "Learning curves", body)


def across_environments(data: StudyData) -> Section | None:
    """Return the section that aggregates scores over environments; None if there is only one."""
    if len(data.tasks) == 1:
        return None
    title = "Aggregate over environments"
    missing = _missing_scale(data)
    if missing:
        return Section("across", title, [f"Scores cannot be aggregated: {missing}."])
    elsewhere = [name for name in data.controllers if name not in data.trained_on_all_tasks]
    body: list[Part] = []
    if elsewhere:
        body.append(f"Excluded, because they were not trained on every environment: {', '.join(elsewhere)}.")
    if not data.trained_on_all_tasks:
        return Section("across", title, body)
    scores = data.scores[data.scores["controller"].isin(data.trained_on_all_tasks)]
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
            f"Normalised final scores over {len(data.tasks)} environments: the random rule scores 0, the "
            "best rule 1.",
            ["controller", "runs", "mean ± std", "IQM [95%]"],
            rows,
            found.reset_index(),
        ),
        Picture("profiles_across", "Performance profiles over all environments.", profiles),
    ]
    return Section("across", title, body)


def episode_metrics_section(data: StudyData) -> Section:
    """Return the section with all metrics of the last evaluation, and the components of the reward."""
    body: list[Part] = [
        f"Means over the episodes of the last {data.mode} evaluation; for learners also over seeds."
    ]
    has_components = False
    for place, task in enumerate(data.tasks):
        names = list(data.on(task))
        rules = data.ranked_rules(task)
        columns = {name: data.of_controller(task, name) for name in names}
        columns |= {f"rule {rule}": data.of_rule(task, rule) for rule in rules}
        means = pd.DataFrame(
            {label: found.reindex(columns=data.metrics).mean() for label, found in columns.items()}
        ).dropna(how="all")
        where = data.where(task)
        body.append(
            Table(
                f"episode_metrics{data.file_suffix(place)}",
                f"Episode metrics{where}.",
                ["metric", *columns],
                [
                    [data.readable(str(metric)), *map(formatted, row)]
                    for metric, row in zip(means.index, means.to_numpy(), strict=True)
                ],
                means.rename_axis("metric").reset_index(),
            )
        )
        components = means[[str(name).startswith(_COMPONENT) for name in means.index]]
        if len(components):
            has_components = True
            picture = plots.reward_components(components.T)
            body.append(
                Picture(
                    f"components{data.file_suffix(place)}",
                    f"Components of the reward{where}, from the episode metrics `{_COMPONENT}...`, each on "
                    "its own scale (`headway list metrics` states whether they are weighted): rewards to "
                    "the right of 0, penalties to the left. Components that are 0 throughout are omitted.",
                    picture,
                )
            )
    if not has_components:
        body.append(
            "The reward is not shown by component, because the environment reports no metrics with names "
            "that begin with `reward_`."
        )
    return Section("episode_metrics", "Episode metrics of the last evaluation", body)


def _missing_scale(data: StudyData) -> str:
    """Return why scores of different environments cannot be normalised, or an empty string if they can."""
    missing = [task for task in data.tasks if task not in data.scale]
    if not missing:
        return ""
    return (
        f"{', '.join(missing)} {'lacks' if len(missing) == 1 else 'lack'} the random rule (score 0) or a "
        "rule better than it (score 1) on the episodes of the curves; add `random` and at least one rule "
        "that beats it to `evaluation.rules`"
    )
