"""Sections on learning curves, on all environments together, and on the metrics of the last evaluation."""

from itertools import combinations

import pandas as pd

from headway.stats import frames, plots, ranks
from headway.stats.samples import CONFIDENCE
from headway.wording import counted
from headway_launch.console.number_formats import formatted, with_deviation, with_interval
from headway_launch.report.elements import Part, Picture, Section, Table
from headway_launch.report.sections.setting import swept_settings
from headway_launch.report.study_data import StudyData
from headway_launch.studies.learner_pairs import p_text
from headway_launch.studies.runs import rule_phases

_SIGNIFICANCE = 1 - CONFIDENCE
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
    elsewhere = [name for name in data.controllers if name not in data.trained_on_all_tasks]
    body: list[Part] = []
    if elsewhere:
        body.append(f"Excluded, because they were not trained on every environment: {', '.join(elsewhere)}.")
    if not data.trained_on_all_tasks:
        return Section("across", title, body)
    scores = data.scores[data.scores["controller"].isin(data.trained_on_all_tasks)]
    if missing := _missing_scale(data):
        means = scores.pivot_table("final_reward", "task", "controller", sort=False)
        body += [
            f"Scores cannot be aggregated: {missing}.",
            *_without_sweeps(data, _ranks(data.sign * means)),
        ]
        return Section("across", title, body)
    signed = scores.assign(final_reward=data.sign * scores["final_reward"])
    scaled = frames.normalised_by_rules(signed, "final_reward", data.scale)
    found = frames.summary(scaled)
    by_task = {task: frames.summary(scaled[scaled["task"] == task]) for task in data.tasks}
    rows = [
        [
            str(name),
            *(
                with_deviation(of_task["mean"][str(name)], of_task["std"][str(name)])
                for of_task in by_task.values()
            ),
            str(int(row["runs"])),
            with_deviation(row["mean"], row["std"]),
            with_interval(row["iqm"], row["iqm_low"], row["iqm_high"]),
        ]
        for name, row in found.iterrows()
    ]
    of_tasks = {
        f"{task}: {column}": of_task[column]
        for task, of_task in by_task.items()
        for column in ("mean", "std")
    }
    profiles = plots.performance_profiles(frames.profiles(scaled), "normalised final score", data.styles)
    body += [
        Table(
            "across_environments",
            "Normalised final scores: the random rule scores 0, the best rule 1. Mean ± standard deviation "
            "over seeds on each environment and over all runs, and interquartile mean (IQM) over the runs of "
            f"all {len(data.tasks)} environments.",
            ["controller", *data.tasks, "runs", "all: mean ± std", "all: IQM [95%]"],
            rows,
            found.assign(**of_tasks).reset_index(),
        ),
        Picture("profiles_across", "Performance profiles over all environments.", profiles),
    ]
    means = pd.DataFrame({task: of_task["mean"] for task, of_task in by_task.items()}).T
    body += _without_sweeps(data, [*_ranks(means), *_rank_tests(means)])
    return Section("across", title, body)


def _without_sweeps(data: StudyData, ranks_and_tests: list[Part]) -> list[Part]:
    """Return ranks over tasks and their tests, or why there are none: values of a setting are no sample."""
    if ranks_and_tests and (swept := swept_settings(data)):
        keys = ", ".join(swept)
        return [f"No ranks, and no tests of them: results at several values of {keys} are not independent."]
    return ranks_and_tests


def _ranks(scores: pd.DataFrame) -> list[Part]:
    """Return the ranks of controllers on each task and on average; `scores`: tasks x controllers."""
    tasks, controllers = scores.shape
    if controllers < 2:
        return []
    found, tested = frames.rank_table(scores), ""
    if controllers > 2:
        friedman = ranks.friedman(scores.to_numpy())
        tested = (
            " Friedman's test of the hypothesis that the order is random on each of them: chi-squared "
            f"{formatted(friedman.statistic)}, p {p_text(friedman.p_value)}."
        )
    return [
        "Ranks take each environment as one observation, without the variation between seeds. Environments "
        f"are few in most studies; the differences on each of them then say more.{tested}",
        Table(
            "ranks",
            "Ranks of the mean final scores on each environment, 1 is the best, and their average over "
            f"{tasks} environments.",
            ["controller", *map(str, scores.index), "average rank"],
            [
                [str(name), *map(formatted, row)]
                for name, row in zip(found.index, found.to_numpy(), strict=True)
            ],
            found.reset_index(),
        ),
    ]


def _rank_tests(scores: pd.DataFrame) -> list[Part]:
    """Return the tests of all pairs of controllers and the diagram of their ranks; `scores`: normalised,
    tasks x controllers."""
    tasks, controllers = scores.shape
    if controllers < 2:
        return []
    found, pairs = frames.rank_table(scores), frames.rank_pairs(scores)
    p_values = dict(zip(combinations(range(controllers), 2), pairs["p_holm"], strict=True))
    groups = ranks.groups(controllers, lambda i, j: p_values[i, j] < _SIGNIFICANCE)
    least = min(1.0, len(pairs) * 2.0 ** (1 - tasks))
    few = f" p (Holm) cannot be below {p_text(least)} here." if least >= _SIGNIFICANCE else ""
    return [
        Table(
            "rank_pairs",
            f"Wilcoxon's signed-rank test of each pair over {tasks} environments, exact, with p corrected by "
            f"Holm for {counted(len(pairs), 'pair')}; and the mean difference of the normalised scores.{few}",
            ["controller", "minus", "mean difference", "p", "p (Holm)"],
            [
                [
                    *(str(row["a"]), str(row["b"]), formatted(row["difference"], sign="+")),
                    *(p_text(row["p"]), p_text(row["p_holm"])),
                ]
                for row in pairs.to_dict("records")
            ],
            pairs,
            words=frozenset({0, 1}),
        ),
        Picture(
            "ranks",
            f"Critical-difference diagram: average ranks over {tasks} environments, best at the left. Bars "
            "join learners of which no two differ (p (Holm) of Wilcoxon's test below 5%).",
            plots.rank_diagram({str(name): rank for name, rank in found["average_rank"].items()}, groups),
        ),
    ]


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
        f"{'; '.join(missing)} {'lacks' if len(missing) == 1 else 'lack'} the random rule (score 0) or a "
        "rule better than it (score 1) on the episodes of the curves; add `random` and at least one rule "
        "that beats it to `evaluation.rules`"
    )
