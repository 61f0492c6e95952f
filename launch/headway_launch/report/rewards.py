"""Sections on what was reached: the papers' form, the sound form, curves, profiles, other figures."""

from typing import Any

import pandas as pd

from headway.stats import FEWEST_POINTS, frames, plots
from headway_launch.report.parts import (
    MISSING,
    Part,
    Picture,
    Section,
    Table,
    figure,
    with_deviation,
    with_interval,
)
from headway_launch.report.study_data import DifferenceToBest, StudyData, over_known
from headway_launch.runner.comparison import SEEDS_FOR_A_CLAIM


def published_form(data: StudyData) -> Section:
    """Mean and standard deviation of the final reward, and the AUC, as the papers' Table 3 has them."""
    rows: list[list[str]] = []
    exact: list[dict[str, object]] = []
    rules: set[int] = set()
    for task in data.tasks:
        for controller, members in data.on(task).items():
            cells, figures = _published(data, [row.run_id for row in members])
            rows.append([*_place(data, task), controller, str(len(members)), *cells])
            exact.append({"environment": task, "controller": controller, "seeds": len(members), **figures})
        values = data.rules_beside_curves.get(task, {})
        for rule, value in sorted(values.items(), key=lambda item: -data.sign * item[1]):
            rules.add(len(rows))
            before, after = [MISSING] * 3 * (len(_curves(data)) - 1), [MISSING] * 2
            rows.append([*_place(data, task), f"rule {rule}", MISSING, *before, figure(value), *after])
            name = f"{data.mode}_final_reward_mean"
            exact.append({"environment": task, "controller": f"rule {rule}", name: value})
    headings = [*_environment(data), "controller", "seeds"]
    for name in _curves(data):
        what = "reward" if name == "training" else data.what
        headings += [f"{name}: final {what}", f"{name}: AUC, own range", f"{name}: AUC, study's range"]
    table = Table(
        "published_form",
        f"Final {data.what} and AUC over seeds, mean ± standard deviation (ddof = 1), in the form of the "
        "papers' tables.",
        headings,
        rows,
        pd.DataFrame(exact),
        words=_words(data),
        emphasised=frozenset(rules),
    )
    body: list[Part] = [
        f"The final {data.what} is the mean over the last 20% of a curve's steps. The AUC is the area under "
        "the curve after min-max normalisation: by the range of the run's own curve, as published, which "
        "tells how early a run learns but not how well; and by the range of all curves of the study, which "
        "ranks.",
        f"The papers report the curve of training episodes. Beside it stands the {data.mode} evaluation on "
        "days kept apart, which all other parts of this page use.",
        *_of_training(data),
    ]
    body += [table, *_unequal_budgets(data), *_too_short(data), *_one_seed(data)]
    return Section("published", "The form of the papers", body)


def _of_training(data: StudyData) -> list[str]:
    """What is to be known of the training columns, or why there are none."""
    figures = data.training_figures
    if figures is None:
        return ["There are no training columns: no episode ended in training."]
    said = []
    if data.column != "return":
        said.append("The training columns are of the reward, the others of the metric chosen.")
    if data.learned_from_another_reward:
        said.append(
            "Here learners are paid by other rules while training than what is reported "
            "(`env.training_args`, or wrappers of the reward): the training columns are of that reward and "
            "do not compare with the others."
        )
    said += _paid_by_several_rules(data)
    if without := int(figures["final_reward"].isna().sum()):
        said.append(
            f"In {plots.counted(without, 'run')} no episode ended in training: the training columns are "
            "over the others."
        )
    return said


def _too_short(data: StudyData) -> list[str]:
    """A line where runs have a curve, but none that has an area by its own range."""
    said = []
    for name, figures in _curves(data).items():
        if short := int((figures["auc_own"].isna() & figures["final_reward"].notna()).sum()):
            each = "iterations in which episodes ended" if name == "training" else "set by `evaluation.every`"
            said.append(f"the {name} curve of {plots.counted(short, 'run')} (its points are {each})")
    if not said:
        return []
    return [
        f"A curve of fewer than {FEWEST_POINTS} points has no AUC by its own range, which would be 0.5 "
        f"whatever was learnt: the mean is over the others. Such is {' and '.join(said)}."
    ]


def _paid_by_several_rules(data: StudyData) -> list[str]:
    """A line for each task on which training curves are of different rewards."""
    alike = {task: data.paid_alike(task) for task in data.tasks}
    return [
        f"Nor do the rows of the training columns{data.where(task)} compare with each other but where "
        f"controllers are paid by the same rules: {'; '.join(', '.join(group) for group in groups)}."
        for task, groups in alike.items()
        if len(groups) > 1
    ]


def _curves(data: StudyData) -> dict[str, pd.DataFrame]:
    """By what a curve is called, `curve_metrics` of those that the runs have."""
    training = {} if data.training_figures is None else {"training": data.training_figures}
    return {**training, data.mode: data.figures}


def _published(data: StudyData, runs: list[str]) -> tuple[list[str], dict[str, object]]:
    """Of some runs, the figures of the training curve and of the evaluation: as read, and whole."""
    cells: list[str] = []
    whole: dict[str, object] = {}
    for name, source in _curves(data).items():
        for column in ("final_reward", "auc_own", "auc_study"):
            found = over_known(source.loc[runs, column])
            cells.append(with_deviation(found.mean, found.std, None if column == "final_reward" else 3))
            whole |= {f"{name}_{column}_mean": found.mean, f"{name}_{column}_std": found.std}
    return cells, whole


def sound_form(data: StudyData) -> Section:
    """Interquartile means with intervals, and differences to the best rule."""
    body: list[Part] = [
        "The interquartile mean leaves out the best and the worst quarter of the seeds, so that one lucky "
        "or failed seed does not decide. A controller is called better or worse than the best rule only "
        f"where the interval excludes 0 over at least {SEEDS_FOR_A_CLAIM} training seeds; with fewer there "
        "is no claim.",
        _sound_table(data),
        *_unequal_budgets(data),
        *([data.narrow] if data.narrow else []),
    ]
    against = {(task, name): data.against_best_rule(task, name) for task, name in data.cells}
    reasons = dict.fromkeys(
        f"{task}: {found.why_not}" for (task, _), found in against.items() if found.why_not
    )
    if not data.best_rules:
        body.append(
            "No classical rule was played beside these runs (`evaluation.rules`), so whether learning beats "
            "a simple rule cannot be told here."
        )
    elif reasons:
        body.append(f"No difference to the best rule is given on {'; '.join(reasons)}.")
    body += _one_seed(data)
    for place, task in enumerate(data.tasks):
        found = frames.summary(data.scores_on(task))
        if found["iqm_low"].notna().any():
            values = data.rules_beside_curves.get(task, {})
            body.append(
                Picture(
                    f"intervals{data.numbered(place)}",
                    f"Interquartile means of the final {data.what}{data.where(task)} with their 95% "
                    f"intervals, and the rules on the days of the curves. {data.narrow}".strip(),
                    plots.intervals(found, values, f"IQM of final {data.what}", data.styles, data.sign),
                )
            )
    return Section("sound", "The sound form", body)


def _sound_table(data: StudyData) -> Table:
    rows: list[list[str]] = []
    exact: list[dict[str, Any]] = []
    rules: set[int] = set()
    for task in data.tasks:
        for name, found in frames.summary(data.scores_on(task)).to_dict("index").items():
            seeds, against = int(found["runs"]), data.against_best_rule(task, str(name))
            days = data.by_seed(task, str(name), data.column)
            last = float(days.to_numpy().mean()) if days.size else float("nan")
            iqm = with_interval(found["iqm"], found["iqm_low"], found["iqm_high"])
            place = [*_place(data, task), str(name), str(seeds)]
            rows.append([*place, iqm, figure(last), *_against(data, against, seeds)])
            learner = {"environment": task, "controller": name, "last_evaluation": last}
            learner |= {str(column): value for column, value in found.items()}
            exact.append(learner | _exact(against))
        for rule in data.ranked_rules(task):
            against, mean = data.rule_against_best(task, rule), float(data.by_day(task, rule).mean())
            rules.add(len(rows))
            place = [*_place(data, task), f"rule {rule}", MISSING, MISSING]
            rows.append([*place, figure(mean), *_against(data, against, None)])
            played = {"environment": task, "controller": f"rule {rule}", "last_evaluation": mean}
            exact.append({**played, **_exact(against)})
    names = ["controller", "seeds", f"IQM of final {data.what} [95%]", "last evaluation"]
    return Table(
        "sound_form",
        f"Interquartile mean (IQM) of the final {data.what} with its 95% interval by the stratified "
        f"bootstrap over seeds, on {_which_days(data)}; the mean of all days of the last evaluation; its "
        "paired difference from the best rule on all of them, with the 95% interval by Student's t.",
        [*_environment(data), *names, "minus the best rule [95%]", "interval over", "reading"],
        rows,
        pd.DataFrame(exact),
        words=_words(data) | {len(_environment(data)) + column for column in (5, 6)},
        emphasised=frozenset(rules),
    )


def improvement_section(data: StudyData) -> Section:
    """How probably one controller is better than another, and how the seeds are spread."""
    body: list[Part] = []
    signed = data.scores.assign(score=data.sign * data.scores["score"])
    if len(data.controllers) > 1:
        body += _improvements(data, signed)
    else:
        body.append("There is one learner only, so there is none to compare it with.")
    for place, task in enumerate(data.tasks):
        where = data.where(task)
        if all(len(members) == 1 for members in data.on(task).values()):
            body.append(
                f"There is no performance profile{where}: it is of many seeds, and there is one of each."
            )
            continue
        caption = (
            f"Performance profiles{where}: the share of seeds whose final {data.what} is above a value, with "
            "95% intervals, point by point. "
            + ("Lower is better." if data.lower_is_better else "A curve above another is better there.")
        )
        scores = data.scores_on(task)
        by_name = {str(name): of_name.to_numpy() for name, of_name in scores.groupby("controller")["score"]}
        if off := plots.outliers(by_name, data.sign):
            caption += f" Beyond the axis: {', '.join(f'{name} (at {figure(off[name])})' for name in off)}."
        thresholds = frames.even_thresholds(scores[~scores["controller"].isin(list(off))])
        profiles = frames.profiles(scores, thresholds)
        picture = plots.performance_profiles(profiles, f"final {data.what}", data.styles)
        body.append(Picture(f"profiles{data.numbered(place)}", caption, picture))
    return Section("improvement", "Which is better, and how surely", body)


def _improvements(data: StudyData, signed: pd.DataFrame) -> list[Part]:
    found = frames.improvements(signed)
    shown = {
        (str(row["a"]), str(row["b"])): with_interval(row["probability"], row["low"], row["high"])
        for row in found.to_dict("records")
    }
    names = data.controllers
    rows = [[a, *(shown.get((a, b), MISSING) for b in names)] for a in names]
    return [
        "Probability that a seed of the controller at the left scores better than a seed of the one above, "
        "ties counting half; 0.5 is no difference.",
        Table(
            "probability_of_improvement",
            "Probability of improvement, row over column, with 95% intervals by the stratified bootstrap.",
            ["better than", *names],
            rows,
            found,
        ),
        *([data.narrow] if data.narrow else []),
    ]


def _against(data: StudyData, against: DifferenceToBest, seeds: int | None) -> list[str]:
    """The difference, over what its interval is, and in words; without words for a rule (`seeds` None)."""
    found = against.interval
    if found is None:
        return [MISSING, MISSING, "the best rule" if seeds is None and not against.why_not else MISSING]
    shown = with_interval(found.estimate, found.low, found.high, sign=True)
    if not found.excludes_zero:
        reading = "not told apart"
    else:
        reading = "better" if data.sign * found.estimate > 0 else "worse"
    if seeds is not None and seeds < SEEDS_FOR_A_CLAIM and found.excludes_zero:
        reading = f"no claim ({reading})"
    return [shown, found.method.removeprefix("t over "), reading]


def _exact(against: DifferenceToBest) -> dict[str, float | str]:
    found = against.interval
    if found is None:
        return {}
    return {
        "minus_best_rule": found.estimate,
        "minus_best_rule_low": found.low,
        "minus_best_rule_high": found.high,
        "interval": found.method,
    }


def _one_seed(data: StudyData) -> list[str]:
    alone = [name for (_, name), members in data.cells.items() if len(members) == 1]
    if not alone:
        return []
    return [
        f"Of {', '.join(dict.fromkeys(alone))} there is one seed: how seeds differ is not known, and neither "
        "a deviation nor an interval over seeds is given."
    ]


def _unequal_budgets(data: StudyData) -> list[str]:
    """A line where controllers of a task were not trained for the same environment steps."""
    said = []
    for task in data.tasks:
        budgets = data.budgets(task)
        if len({steps for each in budgets.values() for steps in each}) > 1:
            steps = ", ".join(
                f"{name} {' or '.join(f'{number:,}' for number in each)}" for name, each in budgets.items()
            )
            said.append(f"{task}: {steps}" if len(data.tasks) > 1 else steps)
    if not said:
        return []
    return [
        "Seeds were not all trained for the same environment steps (a budget is rounded up to whole "
        f"iterations): {'; '.join(said)}."
    ]


def _which_days(data: StudyData) -> str:
    """Of which days the two kinds of figures are."""
    kinds = {(data.days_of_curves(task), data.days_of_last(task)) for task in data.tasks}
    if len(kinds) > 1:
        return "the curves' days, which are the first of those of the last evaluation"
    [(curves, last)] = kinds
    return f"the curves' {curves}, the first of the last evaluation's {last}"


def _environment(data: StudyData) -> list[str]:
    return ["environment"] if len(data.tasks) > 1 else []


def _place(data: StudyData, task: str) -> list[str]:
    return [task] if len(data.tasks) > 1 else []


def _words(data: StudyData) -> frozenset[int]:
    """The columns that name a row."""
    return frozenset(range(1 + len(_environment(data))))
