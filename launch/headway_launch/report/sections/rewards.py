"""Sections on final rewards: means and AUC, interquartile means, differences from rules, and comparisons."""

from dataclasses import asdict
from pathlib import Path
from typing import Any

import pandas as pd

from headway.stats import frames, plots
from headway.stats.comparison import SEEDS_FOR_A_CLAIM
from headway.stats.curves import FEWEST_POINTS
from headway.wording import counted
from headway_launch.console.number_formats import MISSING, formatted, with_deviation, with_interval
from headway_launch.experiments.start_line import rule_start, start_line
from headway_launch.report.comparison_table import pairs_table
from headway_launch.report.elements import Part, Picture, Section, Table, table_by_task
from headway_launch.report.study_data import DifferenceFromBest, StudyData, mean_of_known

SEEDS_FOR_A_PROFILE = 5
"""Number of seeds per controller below which intervals fill nearly all of a performance profile."""


def final_reward_section(data: StudyData) -> Section:
    """Return the section with mean and standard deviation of final reward and AUC, as papers report them."""
    rows: list[list[str]] = []
    exact: list[dict[str, object]] = []
    rules: set[int] = set()
    for task in data.tasks:
        for controller, members in data.on(task).items():
            cells, values = _curve_results(data, [row.run_id for row in members])
            rows.append([task, controller, str(len(members)), *cells])
            exact.append({"environment": task, "controller": controller, "seeds": len(members), **values})
        of_rules = data.rules_beside_curves.get(task, {})
        for rule, value in ((rule, of_rules[rule]) for rule in data.ranked_rules(task) if rule in of_rules):
            rules.add(len(rows))
            before, after = [MISSING] * 3 * (len(_curves(data)) - 1), [MISSING] * 2
            rows.append([task, f"rule {rule}", MISSING, *before, formatted(value), *after])
            name = f"{data.mode}_final_reward_mean"
            exact.append({"environment": task, "controller": f"rule {rule}", name: value})
    headings = ["controller", "seeds"]
    for name in _curves(data):
        label = "reward" if name == "training" else data.metric_with_unit
        headings += [f"{name}: final {label}", f"{name}: AUC, own range", f"{name}: AUC, study's range"]
    table = table_by_task(
        data.tasks,
        "final_rewards",
        f"Final {data.metric_label} and AUC: mean ± standard deviation over seeds (ddof = 1), as in most "
        "papers' tables.",
        headings,
        rows,
        pd.DataFrame(exact),
        emphasised=frozenset(rules),
    )
    body: list[Part] = [
        f"The final {data.metric_label} is the mean over the last 20% of a curve's steps. The AUC is the "
        "area under the min-max-normalised curve. Normalised by the range of the run's own curve, as in "
        "the literature, it shows how early a run learns but not how well; normalised by the range of all "
        "curves of the study, it can be used to rank controllers.",
        f"Papers usually report the curve of training episodes. The {data.mode} evaluation on held-out "
        "episodes is shown beside it and is used in all other parts of this page.",
        *_training_notes(data),
    ]
    body += [table, *_starts(data), *_unequal_budgets(data), *_too_short(data), *_single_seeds(data)]
    return Section("rewards", f"Final {data.metric_label} and AUC", body)


def _training_notes(data: StudyData) -> list[str]:
    """Return notes on the training columns, or the reason why there are none."""
    metrics = data.training_metrics
    if metrics is None:
        return ["There are no training columns because no episode ended during training."]
    notes = []
    if data.column != "return":
        notes.append("The training columns show the reward, the others the chosen metric.")
    if data.learned_from_another_reward:
        notes.append(
            "Training used another reward or other dynamics than evaluation (`env.training_args` or reward "
            "wrappers): the training columns show the training reward and cannot be compared with the others."
        )
    notes += _differing_training_rewards(data)
    if without := int(metrics["final_reward"].isna().sum()):
        notes.append(
            f"No episode ended during training in {counted(without, 'run')}: the training columns "
            "cover the remaining runs."
        )
    return notes


def _too_short(data: StudyData) -> list[str]:
    """Return a note on curves that are too short for an AUC."""
    causes = []
    for name, metrics in _curves(data).items():
        if short := int((metrics["auc_own"].isna() & metrics["final_reward"].notna()).sum()):
            points = (
                "iterations in which episodes ended" if name == "training" else "set by `evaluation.every`"
            )
            causes.append(f"the {name} curve of {counted(short, 'run')} (points: {points})")
    if not causes:
        return []
    return [
        f"A curve with fewer than {FEWEST_POINTS} points gets no AUC: by its own range it would be 0.5 "
        "whatever the run learned; means are over the remaining runs. This applies to "
        f"{' and '.join(causes)}."
    ]


def _differing_training_rewards(data: StudyData) -> list[str]:
    """Return one note per task whose controllers were trained with different rewards."""
    alike = {task: data.reward_groups(task) for task in data.tasks}
    return [
        f"In the training columns{data.where(task)}, compare only controllers that were trained with the "
        f"same reward: {'; '.join(', '.join(group) for group in groups)}."
        for task, groups in alike.items()
        if len(groups) > 1
    ]


def _curves(data: StudyData) -> dict[str, pd.DataFrame]:
    """Return `curve_metrics` of the training curve, if there is one, and of the evaluation, by name."""
    training = {} if data.training_metrics is None else {"training": data.training_metrics}
    return {**training, data.mode: data.curve_metrics}


def _curve_results(data: StudyData, runs: list[str]) -> tuple[list[str], dict[str, object]]:
    """Return final rewards and AUCs of runs, over all curves: formatted cells, and exact values by column."""
    cells: list[str] = []
    exact: dict[str, object] = {}
    for name, source in _curves(data).items():
        for column in ("final_reward", "auc_own", "auc_study"):
            found = mean_of_known(source.loc[runs, column])
            cells.append(with_deviation(found.mean, found.std, None if column == "final_reward" else 3))
            exact |= {f"{name}_{column}_mean": found.mean, f"{name}_{column}_std": found.std}
    return cells, exact


def interquartile_section(data: StudyData) -> Section:
    """Return the section with interquartile means, their intervals, and differences from the best rule."""
    body: list[Part] = [
        "The interquartile mean discards the best and the worst quarter of the seeds, so that a single "
        "lucky or failed seed does not decide the result; it discards none of fewer than 4 seeds and is "
        "their mean. A learner is called better or worse than the best "
        f"rule only if the interval excludes 0 with at least {SEEDS_FOR_A_CLAIM} training seeds; with fewer "
        "seeds no claim is made. Rules need no seeds: their interval is over episodes.",
        _interquartile_table(data),
        *([data.few_seeds_note] if data.few_seeds_note else []),
    ]
    against = {(task, name): data.against_best_rule(task, name) for task, name in data.cells}
    reasons = dict.fromkeys(f"{task}: {found.reason}" for (task, _), found in against.items() if found.reason)
    if not data.best_rules:
        body.append(
            "The store has no episodes of classical rules (`evaluation.rules`), so the learners cannot be "
            "compared with a simple rule."
        )
    elif reasons:
        body.append(f"No difference from the best rule is given for {'; '.join(reasons)}.")
    body += [f"{line}{data.where(task)}." for task in data.tasks for line in data.gap_lines(task)]
    body += _single_seeds(data)
    for place, task in enumerate(data.tasks):
        found = frames.summary(data.scores_on(task))
        if found["iqm_low"].notna().any():
            values = data.rules_beside_curves.get(task, {})
            body.append(
                Picture(
                    f"intervals{data.file_suffix(place)}",
                    f"Interquartile means of the final {data.metric_label}{data.where(task)} with their 95% "
                    f"intervals, and the rules on the same episodes. {data.few_seeds_note}".strip(),
                    plots.intervals(
                        found, values, f"IQM of final {data.metric_with_unit}", data.styles, data.sign
                    ),
                )
            )
    return Section("comparison", "Interquartile means and comparison with the rules", body)


def _interquartile_table(data: StudyData) -> Table:
    rows: list[list[str]] = []
    exact: list[dict[str, Any]] = []
    rules: set[int] = set()
    for task in data.tasks:
        for name, found in frames.summary(data.scores_on(task)).to_dict("index").items():
            seeds, against = int(found["runs"]), data.against_best_rule(task, str(name))
            episodes = data.by_seed(task, str(name), data.column)
            last = float(episodes.to_numpy().mean()) if episodes.size else float("nan")
            iqm = with_interval(found["iqm"], found["iqm_low"], found["iqm_high"])
            place = [task, str(name), str(seeds)]
            rows.append([*place, iqm, formatted(last), *against_cells(data, against, seeds)])
            learner = {"environment": task, "controller": name, "last_evaluation": last}
            learner |= {str(column): value for column, value in found.items()}
            exact.append(learner | exact_against(against))
        for rule in data.ranked_rules(task):
            against, mean = data.rule_against_best(task, rule), float(data.by_episode(task, rule).mean())
            rules.add(len(rows))
            place = [task, f"rule {rule}", MISSING, MISSING]
            rows.append([*place, formatted(mean), *against_cells(data, against, None)])
            of_rule = {"environment": task, "controller": f"rule {rule}", "last_evaluation": mean}
            exact.append({**of_rule, **exact_against(against)})
    names = ["controller", "seeds", f"IQM of final {data.metric_with_unit} [95%]", "last evaluation"]
    return table_by_task(
        data.tasks,
        "interquartile_means",
        f"Interquartile mean (IQM) of the final {data.metric_label} with its 95% interval by the "
        f"stratified bootstrap over seeds, evaluated on {_evaluation_episodes(data)}; mean over all "
        "episodes of the last evaluation; and its paired difference from the best rule on those episodes, "
        "with the 95% interval by Student's t.",
        [*names, "difference from the best rule [95% interval]", "interval over", "conclusion"],
        rows,
        pd.DataFrame(exact),
        words=(6, 7),
        emphasised=frozenset(rules),
    )


def improvement_section(data: StudyData) -> Section:
    """Return the section with probabilities of improvement and performance profiles."""
    body: list[Part] = []
    signed = data.scores.assign(final_reward=data.sign * data.scores["final_reward"])
    if len(data.controllers) > 1:
        body += [*_learner_pairs(data), *_improvements(data, signed)]
    else:
        body.append("The study has only one learner, so there is no other to compare it with.")
    for place, task in enumerate(data.tasks):
        where = data.where(task)
        if all(len(members) < SEEDS_FOR_A_PROFILE for members in data.on(task).values()):
            body.append(
                f"There is no performance profile{where}: it needs at least {SEEDS_FOR_A_PROFILE} seeds per "
                "controller."
            )
            continue
        caption = (
            f"Performance profiles{where}: the share of seeds whose final {data.metric_label} is above a "
            "value, with pointwise 95% intervals. "
            + ("Lower is better." if data.lower_is_better else "A higher curve is better.")
        )
        scores = data.scores_on(task)
        by_name = {
            str(name): of_name.to_numpy() for name, of_name in scores.groupby("controller")["final_reward"]
        }
        if off := plots.outliers(by_name, data.sign):
            caption += f" Outside the axis: {', '.join(f'{name} ({formatted(off[name])})' for name in off)}."
        thresholds = frames.even_thresholds(scores[~scores["controller"].isin(list(off))])
        profiles = frames.profiles(scores, thresholds)
        picture = plots.performance_profiles(profiles, f"final {data.metric_with_unit}", data.styles)
        body.append(Picture(f"profiles{data.file_suffix(place)}", caption, picture))
    return Section("improvement", "Comparison of the learners", body)


def _learner_pairs(data: StudyData) -> list[Part]:
    """Return a table per task of the differences between learners, or the reason why there is none."""
    parts: list[Part] = []
    if data.learner_pairs:
        parts.append(
            f"Learners differ if p (Holm) is below 5% with at least {SEEDS_FOR_A_CLAIM} seeds of both. The "
            "number of seeds needed is for planning: it takes the observed difference, which few seeds "
            "estimate badly, for the true one."
        )
    for place, task in enumerate(data.tasks):
        if found := data.learner_pairs.get(task):
            caption = (
                f"Differences between learners{data.where(task)} in the last evaluation: "
                f"{data.readable(data.column)}, paired by episode, with 95% intervals by Student's t over "
                "the seeds of both and the episodes"
            )
            parts.append(pairs_table(found, f"learner_pairs{data.file_suffix(place)}", caption))
        elif len(data.on(task)) > 1:
            parts.append(
                f"The learners were not evaluated on common episodes of a last evaluation{data.where(task)}, "
                "so there are no paired differences between them."
            )
    return parts


def _improvements(data: StudyData, signed: pd.DataFrame) -> list[Part]:
    found = frames.improvements(signed)
    if found.empty:
        return ["There is no probability of improvement: it needs several seeds of both controllers."]
    shown = {
        (str(row["a"]), str(row["b"])): with_interval(row["probability"], row["low"], row["high"])
        for row in found.to_dict("records")
    }
    names = data.controllers
    rows = [[a, *(shown.get((a, b), MISSING) for b in names)] for a in names]
    return [
        "Probability that a random seed of the row's controller scores better than one of the column's, with "
        "ties counted as one half; 0.5 means no difference.",
        Table(
            "probability_of_improvement",
            "Probability of improvement, row over column, with 95% intervals by the stratified bootstrap. "
            "There is no interval where all resamples agree, as where every seed of one scores better than "
            "every seed of the other: the bootstrap cannot tell how uncertain that is.",
            ["better than", *names],
            rows,
            found,
        ),
        *([data.few_seeds_note] if data.few_seeds_note else []),
    ]


def against_cells(data: StudyData, against: DifferenceFromBest, seeds: int | None) -> list[str]:
    """Return cells: difference, sample of its interval, conclusion. `seeds` is None for rules."""
    found = against.interval
    if found is None:
        return [MISSING, MISSING, "the best rule" if seeds is None and not against.reason else MISSING]
    shown = with_interval(found.estimate, found.low, found.high, sign="+")
    if not found.excludes_zero:
        conclusion = "no difference shown"
    else:
        conclusion = "better" if data.sign * found.estimate > 0 else "worse"
    if seeds is not None and seeds < SEEDS_FOR_A_CLAIM and found.excludes_zero:
        conclusion = f"no claim ({conclusion})"
    return [shown, found.method.removeprefix("t over "), conclusion]


def exact_against(against: DifferenceFromBest) -> dict[str, float | str]:
    """Return the values of `against_cells` with all digits, by column; none if they are unknown."""
    found = against.interval
    if found is None:
        return {}
    return {
        "minus_best_rule": found.estimate,
        "minus_best_rule_low": found.low,
        "minus_best_rule_high": found.high,
        "interval": found.method,
    }


def _single_seeds(data: StudyData) -> list[str]:
    alone = [name for (_, name), members in data.cells.items() if len(members) == 1]
    if not alone:
        return []
    names = list(dict.fromkeys(alone))
    return [
        f"Only one seed {'each ' if len(names) > 1 else ''}of {', '.join(names)} was trained: the variation "
        "between seeds is unknown, so no standard deviation and no interval over seeds is given."
    ]


def _starts(data: StudyData) -> list[Part]:
    """Return a table of the controllers that started from a rule, and notes on other starts and stages."""
    lines, rows, exact = [], list[list[str]](), list[dict[str, Any]]()
    for (task, controller), members in data.cells.items():
        folders = [Path(row.directory) for row in members]
        name = f"{controller}{data.where(task)}"
        store = folders[0].parents[1]
        lines.append(start_line(name, store, folders, data.metric, with_rule=False))
        if found := rule_start(store, folders, data.metric):
            values = map(formatted, (found.imitated, found.played))
            rows.append([task, controller, found.rule, f"{found.env_steps:,}", *values])
            exact.append({"environment": task, "controller": controller, **asdict(found)})
    notes: list[Part] = [f"{line}." for line in lines if line]
    if not rows:
        return notes
    column = data.readable(data.column)
    table = table_by_task(
        data.tasks,
        "starts",
        "Controllers that started from a rule, which acted in the first steps of each run: mean of the "
        "policies that imitated it, at the end of these steps, and of the rule, on the curve's episodes.",
        ["controller", "rule", "steps", f"{data.mode}: {column} after imitation", f"the rule's {column}"],
        rows,
        pd.DataFrame(exact),
        words=(2,),
    )
    return [table, *notes]


def _unequal_budgets(data: StudyData) -> list[str]:
    """Return a note if controllers of a task were trained for different numbers of environment steps."""
    differing = []
    for task in data.tasks:
        budgets = data.budgets(task)
        if len({steps for each in budgets.values() for steps in each}) > 1:
            steps = ", ".join(
                f"`{name}` {' or '.join(f'{number:,}' for number in each)}" for name, each in budgets.items()
            )
            differing.append(f"{task}: {steps}" if len(data.tasks) > 1 else steps)
    if not differing:
        return []
    return [
        "Not all seeds were trained for the same number of environment steps (a budget is rounded up to "
        f"whole iterations): {'; '.join(differing)}."
    ]


def _evaluation_episodes(data: StudyData) -> str:
    """Describe the episodes of the curves and of the last evaluation."""
    kinds = {(data.curve_episodes(task), data.last_episodes(task)) for task in data.tasks}
    if len(kinds) > 1:
        return "the episodes of the curves, which are also the first of the last evaluation's episodes"
    [(curves, last)] = kinds
    number, _, noun = curves.partition(" ")
    first = {"episode": "is also the first", "episodes": f"are also the first {number}"}
    which = first.get(noun, "are also the first")
    return f"{curves} per point of the curves, which {which} of the last evaluation's {last}"
