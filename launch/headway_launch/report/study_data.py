"""The data of a report: what a study's runs came to, beside the rules on the same days."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pandas as pd

from headway.contracts.errors import HeadwayError
from headway.events import LABELS
from headway.stats import Interval, MeanStd, frames, mean_std, plots
from headway.store import RunSelection
from headway.store.query import LABELS as WHOSE
from headway_launch.experiments.parameters import flat
from headway_launch.runner.comparison import SEEDS_FOR_A_CLAIM, difference
from headway_launch.studies.runs import (
    configuration,
    counted_runs,
    curve_points,
    curves_of,
    rules_beside,
    study_runs,
)

if TYPE_CHECKING:
    from headway.store.index import RunRow

RANDOM = "random"
"""The rule that scores are 0 of, where environments are put together."""


@dataclass(frozen=True)
class DifferenceToBest:
    """A controller's difference to the best rule of its task on common days; None where it is not known."""

    interval: Interval | None
    why_not: str = ""


def over_known(figures: pd.Series) -> MeanStd:
    """Mean and deviation over the runs that have a figure; NaN where none has."""
    known = figures.dropna().to_numpy()
    return mean_std(known) if len(known) else MeanStd(float("nan"), float("nan"), 0)


class StudyData:
    """What the report of a study is made from; each part is read and computed when first asked for.

    Raises HeadwayError if there is no such study, nothing in it has finished, or a finished run has not the
    metric.
    """

    def __init__(
        self,
        root: Path,
        study: str,
        metric: str | None = None,
        lower_is_better: bool = False,
        low: float | None = None,
    ) -> None:
        self.study, self.lower_is_better, self.low = study, lower_is_better, low
        self.every = RunSelection(root, tuple(study_runs(root, study)))
        counted, self.left_out = counted_runs(self.every.rows, study)
        self.runs = RunSelection(root, tuple(counted))
        self.metric = metric or self._usual_metric()
        group, _, self.column = self.metric.rpartition("/")
        if not group.startswith("evaluation_"):
            raise HeadwayError(
                f"--metric: {self.metric!r} is no metric of evaluation; write evaluation_greedy/NAME or "
                "evaluation_sampled/NAME"
            )
        self.mode = group.removeprefix("evaluation_")
        self.curves = curves_of(self.runs, self.metric)

    @property
    def sign(self) -> int:
        """Scores times it are the better the higher."""
        return -1 if self.lower_is_better else 1

    @property
    def what(self) -> str:
        """What the metric is called in text."""
        return "reward" if self.column == "return" else self.column.replace("_", " ")

    @cached_property
    def tasks(self) -> list[str]:
        """Environments, in the order of the runs."""
        return list(dict.fromkeys(self.runs.names[row.cell].task for row in self.runs.rows))

    @cached_property
    def controllers(self) -> list[str]:
        """Learners, in order."""
        return sorted({self.runs.names[row.cell].controller for row in self.runs.rows})

    @cached_property
    def cells(self) -> dict[tuple[str, str], list["RunRow"]]:
        """The runs of each task and controller, in order."""
        found: dict[tuple[str, str], list[RunRow]] = {}
        for row in self.runs.rows:
            name = self.runs.names[row.cell]
            found.setdefault((name.task, name.controller), []).append(row)
        return {
            (task, name): found[task, name]
            for task in self.tasks
            for name in self.controllers
            if (task, name) in found
        }

    def on(self, task: str) -> dict[str, list["RunRow"]]:
        """The runs of each controller on a task, in order."""
        return {name: members for (of_task, name), members in self.cells.items() if of_task == task}

    @cached_property
    def everywhere(self) -> list[str]:
        """The controllers that were trained on every task."""
        return [name for name in self.controllers if all((task, name) in self.cells for task in self.tasks)]

    @cached_property
    def styles(self) -> dict[str, dict[str, Any]]:
        """One colour a controller, in all pictures."""
        return plots.colours(self.controllers)

    @cached_property
    def figures(self) -> pd.DataFrame:
        """`curve_metrics` of the metric."""
        return frames.curve_metrics(self.curves)

    @cached_property
    def training_figures(self) -> pd.DataFrame | None:
        """`curve_metrics` of the training curve, in which the papers report, a row a run: NaN where no
        episode ended in it; None where none ended in any. Runs need no step in common: where workers are
        asynchronous, episodes end at other updates in each."""
        points = curve_points(self.runs, "training/return")
        if points.empty:
            return None
        return frames.curve_metrics(points).reindex([row.run_id for row in self.runs.rows])

    @cached_property
    def learned_from_another_reward(self) -> bool:
        """The training curve is of other rewards or dynamics than what is reported."""
        envs = (configuration(row.directory)["env"] for row in self.runs.rows)
        return any(env.get("training_args") or _reward_wrappers(env) for env in envs)

    def paid_alike(self, task: str) -> list[list[str]]:
        """The controllers of a task, those together that learn from the same rewards and dynamics."""
        groups: dict[str, list[str]] = {}
        for name, members in self.on(task).items():
            env = configuration(members[0].directory)["env"]
            learned_from = {**dict(flat(env["args"])), **dict(flat(env.get("training_args") or {}))}
            key = json.dumps([learned_from, _reward_wrappers(env)], sort_keys=True)
            groups.setdefault(key, []).append(name)
        return list(groups.values())

    @cached_property
    def scores(self) -> pd.DataFrame:
        """A row a run: `controller`, `task`, `score` (its final reward, or what the metric is)."""
        figures = self.figures.rename(columns={"final_reward": "score"})
        in_order = [row.run_id for members in self.cells.values() for row in members]
        return figures.loc[in_order, ["controller", "task", "score"]]

    @cached_property
    def narrow(self) -> str:
        """What is to be said beside intervals by the bootstrap; empty where all cells have seeds enough."""
        if min(len(members) for members in self.cells.values()) >= SEEDS_FOR_A_CLAIM:
            return ""
        return (
            f"With fewer than {SEEDS_FOR_A_CLAIM} seeds the bootstrap's intervals are too narrow: of two "
            "seeds they are the lower and the higher one, and where all seeds agree they shrink to a point."
        )

    def scores_on(self, task: str) -> pd.DataFrame:
        """The rows of `scores` of one task."""
        return self.scores[self.scores["task"] == task]

    def where(self, task: str) -> str:
        """` on TASK`, where there are several."""
        return f" on {task}" if len(self.tasks) > 1 else ""

    @cached_property
    def days(self) -> pd.DataFrame:
        """A row a day of a run's last evaluation in the metric's mode, with all its figures."""
        return self.runs.evaluations(mode=self.mode, final=True)

    def days_of_curves(self, task: str) -> str:
        """`10 days`: how many a point of a task's curves, and so a final reward, is the mean of."""
        asked = (configuration(row.directory)["evaluation"] for row in self._runs_on(task))
        return _days({int(evaluation["episodes"]) for evaluation in asked})

    def days_of_last(self, task: str) -> str:
        """`100 days`: how many a task's last evaluations have; those of the curves are among them."""
        on_task = self.days[self.days["task"] == task]
        return _days(set(on_task.groupby("run_id").size().astype(int)))

    def budgets(self, task: str) -> dict[str, list[int]]:
        """The environment steps that seeds of each controller were trained for, each number once."""
        return {name: sorted({row.env_steps for row in members}) for name, members in self.on(task).items()}

    @cached_property
    def rules(self) -> pd.DataFrame:
        """A row a day of a rule, of those rules that have the metric."""
        played = self.runs.rules()
        return played.dropna(subset=[self.column]) if self.column in played else played.iloc[:0]

    @cached_property
    def rules_beside_curves(self) -> dict[str, dict[str, float]]:
        """Task -> rule -> mean over the days of the curves."""
        return rules_beside(self.runs, self.metric)

    @cached_property
    def best_rules(self) -> dict[str, str]:
        """Of each task that has rules, the one with the best mean over the days of the last evaluation."""
        ranked = {task: self.ranked_rules(task) for task in self.tasks}
        return {task: rules[0] for task, rules in ranked.items() if rules}

    @cached_property
    def scale(self) -> dict[str, tuple[float, float]]:
        """Of each task whose best rule is better than random play: (random, best), times the sign, on the
        days of the curves."""
        found = {}
        for task, values in self.rules_beside_curves.items():
            signed = {rule: self.sign * value for rule, value in values.items()}
            if RANDOM in signed and max(signed.values()) > signed[RANDOM]:
                found[task] = (signed[RANDOM], max(signed.values()))
        return found

    def ranked_rules(self, task: str) -> list[str]:
        """A task's rules, the best first."""
        of_task = self.rules[self.rules["task"] == task]
        if of_task.empty:
            return []
        means = of_task.groupby("rule")[self.column].mean() * self.sign
        return [str(rule) for rule in means.sort_values(ascending=False).index]

    def numbered(self, place: int) -> str:
        """What tells the names of files apart where there is one a task."""
        return f"_{place + 1}" if len(self.tasks) > 1 else ""

    def by_seed(self, task: str, controller: str, column: str) -> pd.DataFrame:
        """Runs by days of a column, in the last evaluation."""
        of_cell = self.days[(self.days["task"] == task) & (self.days["controller"] == controller)]
        if column not in of_cell:
            return pd.DataFrame()
        return of_cell.pivot_table(index="run_id", columns="episode_seed", values=column)

    def by_day(self, task: str, rule: str) -> "pd.Series[float]":
        """A rule's days, by `episode_seed`."""
        of_rule = self.rules[(self.rules["task"] == task) & (self.rules["rule"] == rule)]
        return of_rule.set_index("episode_seed")[self.column]

    def against_best_rule(self, task: str, controller: str) -> DifferenceToBest:
        """Its learner's days minus the best rule's."""
        if task not in self.best_rules:
            return DifferenceToBest(None, "no rule was played")
        best = self.by_day(task, self.best_rules[task])
        return self.paired(task, self.by_seed(task, controller, self.column), best)

    def rule_against_best(self, task: str, rule: str) -> DifferenceToBest:
        """A rule's days minus the best rule's."""
        if rule == self.best_rules[task]:
            return DifferenceToBest(None)
        best = self.by_day(task, self.best_rules[task])
        return self.paired(task, self.by_day(task, rule).to_frame().T, best)

    def paired(self, task: str, learned: pd.DataFrame, best: "pd.Series[float]") -> DifferenceToBest:
        """A learner's figures (runs by days, as `by_seed` gives them) minus a rule's on the days of both."""
        if len(self._evaluation_seeds(task)) > 1:
            return DifferenceToBest(None, "the cells were evaluated on different days")
        common = [day for day in learned.columns if day in best.index]
        whole = learned[common].dropna(axis="columns")
        if whole.shape[1] < 2:
            return DifferenceToBest(None, "fewer than two common days")
        return DifferenceToBest(difference(whole.to_numpy().tolist(), best[whole.columns].tolist()))

    def _evaluation_seeds(self, task: str) -> set[int]:
        return {int(configuration(row.directory)["evaluation"]["seed"]) for row in self._runs_on(task)}

    def _runs_on(self, task: str) -> list["RunRow"]:
        return [row for members in self.on(task).values() for row in members]

    @cached_property
    def metrics(self) -> list[str]:
        """Figures of the episodes of evaluation."""
        known = {*WHOSE, *LABELS}
        return [
            str(name) for name in self.days.columns if name not in known and self.days[name].notna().any()
        ]

    @cached_property
    def summaries(self) -> pd.DataFrame:
        """A row a run: what it used. Columns of energy are there even where nothing was measured."""
        found = self.runs.summaries().set_index("run_id")
        wanted = ["kwh", "kg_co2", "cpu_kwh", "gpu_kwh", "ram_kwh", "cpu_seconds"]
        for name in wanted:
            found[name] = pd.to_numeric(found[name]) if name in found else float("nan")
        return found

    def _usual_metric(self) -> str:
        """Greedy evaluation, or else the first mode in which all runs were evaluated."""
        evaluated = [configuration(row.directory)["evaluation"]["modes"] for row in self.runs.rows]
        for mode in ("greedy", "sampled"):
            if all(mode in modes for modes in evaluated):
                return f"evaluation_{mode}/return"
        raise HeadwayError(
            f"some runs of {self.study} were evaluated greedily only and others sampled only, so no curve is "
            "of all; train them with a mode in common, such as evaluation.modes=[greedy]"
        )


def _reward_wrappers(env: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """Those of an environment's wrappers that only change rewards, and so are there in training only."""
    from headway.registry import wrapper_entry

    return [each for each in env.get("wrappers", ()) if wrapper_entry(each["name"]).only_rewards]


def _days(numbers: set[int]) -> str:
    return plots.counted(numbers.pop(), "day") if len(numbers) == 1 else "days that differ"
