"""The section on the absolute metric: the best policies of the trainings on new episodes."""

from statistics import fmean
from typing import Any

import pandas as pd

from headway.contracts.entries import is_lookahead
from headway.stats import frames
from headway.stats.comparison import difference
from headway.wording import counted
from headway_launch.console.number_formats import MISSING, formatted, with_deviation, with_interval
from headway_launch.report.elements import Part, Section, table_by_task
from headway_launch.report.sections.rewards import against_cells, exact_against
from headway_launch.report.study_data import DifferenceFromBest, StudyData
from headway_launch.studies.kept_episodes import kept_episodes


def absolute_metric_section(data: StudyData) -> Section | None:
    """Return the section; None if `headway compare --best --keep` has stored no episodes of the metric."""
    rows: list[list[str]] = []
    exact: list[dict[str, Any]] = []
    rules: set[int] = set()
    notes: list[str] = []
    for task in data.tasks:
        on_task = data.on(task)
        kept = {name: kept_episodes(members, data.mode, [data.column]) for name, members in on_task.items()}
        kept = {name: found for name, found in kept.items() if found[0]}
        of_rules = {
            rule: float(episodes[data.column].mean())
            for _, of_rule in kept.values()
            for rule, episodes in of_rule.items()
        }
        ranked = sorted(of_rules, key=lambda rule: -data.sign * of_rules[rule])
        # The study itself may have no rules.
        best = data.best_rules.get(task, next((rule for rule in ranked if not is_lookahead(rule)), ""))
        numbers: set[int] = set()
        for controller, (runs, of_rule) in kept.items():
            members = on_task[controller]
            # Episodes x runs, without the episodes in which a run lacks the metric.
            played = pd.DataFrame({run: each[data.column] for run, each in runs.items()}).dropna()
            if played.empty:
                notes.append(f"{controller}{data.where(task)}: no episode has {data.column}")
                continue
            learned = played.to_numpy().T.tolist()
            if len(learned) < len(members):
                seeds = counted(len(members), "seed")
                notes.append(f"{controller}{data.where(task)}: {len(learned)} of its {seeds}")
            scores = pd.DataFrame(
                {"controller": controller, "task": task, "final_reward": map(fmean, learned)}
            )
            [row] = frames.summary(scores).to_dict("records")
            found = {str(name): value for name, value in row.items()}
            against = DifferenceFromBest(None, "no rule was run")
            if best in of_rule:
                both = played.assign(rule=of_rule[best][data.column]).dropna()
                against = DifferenceFromBest(None, "fewer than two common episodes")
                if len(both) > 1:
                    *of_seeds, of_best = both.to_numpy().T.tolist()
                    against = DifferenceFromBest(difference(of_seeds, of_best))
            numbers |= set(map(len, learned))
            rows.append(
                [
                    *(task, controller, str(len(learned)), with_deviation(found["mean"], found["std"])),
                    with_interval(found["iqm"], found["iqm_low"], found["iqm_high"]),
                    *against_cells(data, against, len(learned)),
                ]
            )
            exact.append({"environment": task, "controller": controller, **found, **exact_against(against)})
        for rule in ranked:
            rules.add(len(rows))
            name, last = f"rule {rule}", "the best rule" if rule == best else MISSING
            cells = [name, MISSING, formatted(of_rules[rule]), MISSING, MISSING, MISSING, last]
            rows.append([task, *cells])
            exact.append({"environment": task, "controller": name, "mean": of_rules[rule]})
        if numbers:
            number = f"{' or '.join(map(str, sorted(numbers)))} episodes"
            notes.append(f"Evaluated{data.where(task)}: {number} per seed")
    if not rows:
        return None
    name = data.metric_with_unit
    table = table_by_task(
        data.tasks,
        "absolute_metric",
        f"Absolute metric: {name} of each seed's best policy on other episodes than those that selected it. "
        "Mean ± standard deviation over seeds (ddof = 1); interquartile mean (IQM) over seeds with its 95% "
        "interval by the stratified bootstrap; and the paired difference from the best rule on the same "
        "episodes, with the 95% interval by Student's t.",
        [
            *("controller", "seeds", f"{name}: mean ± std", "IQM [95%]"),
            *("difference from the best rule [95% interval]", "interval over", "conclusion"),
        ],
        rows,
        pd.DataFrame(exact),
        words=(6, 7),
        emphasised=frozenset(rules),
    )
    body: list[Part] = [
        "The best policy of a seed is that of the evaluation with the highest return in its training. It is "
        "evaluated anew because its return in that evaluation, by which it was chosen, is too high (Gorsane "
        "et al. 2022, arXiv:2209.10485, who recommend ten times the episodes of an evaluation). All other "
        "parts of this page are about the last policies.",
        table,
        f"{'; '.join(notes)}.",
    ]
    return Section("absolute_metric", "Absolute metric", body)
