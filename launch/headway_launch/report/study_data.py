"""The data of a report: the results of a study's runs and of the rules on the same episodes."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pandas as pd

from headway.config.experiment import last_iterations, steps_per_iteration
from headway.contracts.entries import is_lookahead
from headway.contracts.errors import HeadwayError
from headway.events import LABELS
from headway.stats import frames, plots
from headway.stats.comparison import SEEDS_FOR_A_CLAIM, difference
from headway.stats.pairs import PairRow
from headway.stats.samples import Interval, MeanStd, mean_std
from headway.store.parquet_log import read
from headway.store.query import LABELS as RUN_LABELS
from headway.store.query import RunSelection
from headway.wording import counted, readable_metric
from headway_launch.experiments.experiment import wrappers_of
from headway_launch.experiments.parameters import flat
from headway_launch.runner.comparison import gap_lines
from headway_launch.studies.runs import (
    common_mode,
    configuration,
    curve_column,
    curve_points,
    curves_of,
    included_runs,
    matching_runs,
    metric_descriptions,
    print_rules_left_out,
    require_results,
    rules_beside,
)

if TYPE_CHECKING:
    from headway.store.index import RunRow

RANDOM = "random"
"""Rule whose score is 0 on the scale that makes environments comparable."""


@dataclass(frozen=True)
class DifferenceFromBest:
    """Difference of a controller from the best rule of its task on common episodes; None if unknown."""

    interval: Interval | None
    reason: str = ""
    """Reason why the difference is unknown."""


def mean_of_known(values: pd.Series) -> MeanStd:
    """Return mean and deviation over the runs that have a value; NaN if none has."""
    known = values.dropna().to_numpy()
    return mean_std(known) if len(known) else MeanStd(float("nan"), float("nan"), 0)


class StudyData:
    """Data of the report of a study, or of several; each part is read and computed when it is first used.

    `others`: store and name of further studies; `where`: conditions on the runs that results include. Raises
    HeadwayError if a study does not exist, has no finished run or shares a cell with another, if a finished
    run lacks the metric, and if a condition is invalid or no run meets them.
    """

    def __init__(
        self,
        root: Path,
        study: str,
        metric: str | None = None,
        lower_is_better: bool = False,
        low: float | None = None,
        others: Sequence[tuple[Path, str]] = (),
        where: Sequence[str] = (),
    ) -> None:
        self.lower_is_better, self.low = lower_is_better, low
        self.studies = (study, *(other for _, other in others))
        every: list[RunRow] = []
        included: list[RunRow] = []
        self.excluded: list[str] = []
        for store, name in ((root, study), *others):
            rows, chosen, excluded = included_runs(store, name, _require_last_evaluation)
            _require_other_cells(every, rows)
            every, included = [*every, *rows], [*included, *chosen]
            self.excluded += [f"{each} of {name}" if others else each for each in excluded]
        self.all_runs = RunSelection(root, tuple(every))
        chosen = matching_runs(included, where)
        if len(chosen) < len(included):
            self.excluded.append(f"{len(included) - len(chosen)} that do not meet `--where`")
        self.runs = RunSelection(root, tuple(chosen), beside=self.all_runs.rows)
        self.metric = curve_column(metric or f"evaluation_{common_mode(self.runs)}/return")
        group, _, self.column = self.metric.rpartition("/")
        if not group.startswith("evaluation_"):
            raise HeadwayError(
                f"--metric: {self.metric!r} is not an evaluation metric; write evaluation_greedy/NAME or "
                "evaluation_sampled/NAME"
            )
        self.mode = group.removeprefix("evaluation_")
        self.curves = curves_of(self.runs, self.metric)

    @property
    def title(self) -> str:
        """Names of the studies."""
        return f"{'Study' if len(self.studies) == 1 else 'Studies'} {', '.join(self.studies)}"

    @property
    def sign(self) -> int:
        """Factor that makes higher scores better: 1, or -1 if lower is better."""
        return -1 if self.lower_is_better else 1

    @property
    def metric_label(self) -> str:
        """Name of the metric in text."""
        return "reward" if self.column == "return" else self.readable(self.column).partition(", ")[0]

    @property
    def metric_with_unit(self) -> str:
        """Name of the metric with its unit, for axes and headings."""
        return "reward" if self.column == "return" else self.readable(self.column)

    def readable(self, metric: str) -> str:
        """Return a metric's name in words with its unit."""
        return readable_metric(metric, self._descriptions.get(metric, ""))

    @cached_property
    def _descriptions(self) -> dict[str, str]:
        return metric_descriptions(self.runs)

    @cached_property
    def tasks(self) -> list[str]:
        """Tasks (environments with their settings), in the order of the runs."""
        return list(dict.fromkeys(self.runs.names[row.cell].task for row in self.runs.rows))

    @cached_property
    def controllers(self) -> list[str]:
        """Names of the learners, sorted."""
        return sorted({self.runs.names[row.cell].controller for row in self.runs.rows})

    @cached_property
    def cells(self) -> dict[tuple[str, str], list["RunRow"]]:
        """Included runs by task and controller, in the order of `tasks` and `controllers`."""
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
        """Return the runs of each controller on a task."""
        return {name: members for (of_task, name), members in self.cells.items() if of_task == task}

    @cached_property
    def trained_on_all_tasks(self) -> list[str]:
        """Controllers trained on every task."""
        return [name for name in self.controllers if all((task, name) in self.cells for task in self.tasks)]

    @cached_property
    def styles(self) -> dict[str, dict[str, Any]]:
        """Plot style of each controller and rule, the same in all pictures."""
        rules = dict.fromkeys(rule for task in self.tasks for rule in self.ranked_rules(task))
        return {**plots.colours(self.controllers), **plots.rule_styles(list(rules))}

    @cached_property
    def curve_metrics(self) -> pd.DataFrame:
        """`frames.curve_metrics` of the metric's curves."""
        return frames.curve_metrics(self.curves)

    @cached_property
    def training_metrics(self) -> pd.DataFrame | None:
        """`frames.curve_metrics` of the training curves, one row per run; None if no episode ended at all.

        NaN for runs in which no episode ended. Runs may have no step in common: with asynchronous workers,
        episodes end at different updates.
        """
        points = curve_points(self.runs, "training/return")
        if points.empty:
            return None
        return frames.curve_metrics(points).reindex([row.run_id for row in self.runs.rows])

    @cached_property
    def learned_from_another_reward(self) -> bool:
        """Whether training uses other rewards or dynamics than evaluation."""
        configs = [configuration(row.directory) for row in self.runs.rows]
        return any(
            config["env"].get("training_args")
            or config.get("stages")
            or wrappers_of(config["env"], only_rewards=True)
            for config in configs
        )

    def reward_groups(self, task: str) -> list[list[str]]:
        """Return the controllers of a task, grouped by the rewards and dynamics that they learn from."""
        groups: dict[str, list[str]] = {}
        for name, members in self.on(task).items():
            config = configuration(members[0].directory)
            env = config["env"]
            learned_from = {**dict(flat(env["args"])), **dict(flat(env.get("training_args") or {}))}
            key = json.dumps(
                [learned_from, config.get("stages"), wrappers_of(env, only_rewards=True)], sort_keys=True
            )
            groups.setdefault(key, []).append(name)
        return list(groups.values())

    @cached_property
    def stage_ends(self) -> dict[str, tuple[int, ...]]:
        """Environment steps after which another stage of training begins, by task whose cells all agree."""
        ends: dict[str, set[tuple[int, ...]]] = {}
        for (task, _), members in self.cells.items():
            ends.setdefault(task, set()).add(_stage_ends(configuration(members[0].directory)))
        return {task: found.pop() for task, found in ends.items() if len(found) == 1}

    @cached_property
    def scores(self) -> pd.DataFrame:
        """One row per run: `controller`, `task` and `final_reward`, the metric over the last 20% of steps."""
        in_order = [row.run_id for members in self.cells.values() for row in members]
        return self.curve_metrics.loc[in_order, ["controller", "task", "final_reward"]]

    @cached_property
    def few_seeds_note(self) -> str:
        """Warning about bootstrap intervals over few seeds; empty if every cell has enough."""
        if min(len(members) for members in self.cells.values()) >= SEEDS_FOR_A_CLAIM:
            return ""
        return (
            f"With fewer than {SEEDS_FOR_A_CLAIM} seeds, bootstrap intervals are too narrow: for two seeds "
            "they span the two values, and if all seeds agree they shrink to a point."
        )

    def scores_on(self, task: str) -> pd.DataFrame:
        """Return the rows of `scores` for one task."""
        return self.scores[self.scores["task"] == task]

    def where(self, task: str) -> str:
        """Return ` on TASK`, or an empty string if the study has only one task."""
        return f" on {task}" if len(self.tasks) > 1 else ""

    @cached_property
    def episodes(self) -> pd.DataFrame:
        """One row per episode of each run's last evaluation in the metric's mode, with all its metrics."""
        return self.runs.evaluations(mode=self.mode, final=True)

    def curve_episodes(self, task: str) -> str:
        """Return the number of evaluation episodes per point of a task's curves, such as `10 episodes`."""
        evaluations = (configuration(row.directory)["evaluation"] for row in self._runs_on(task))
        return _episodes({int(evaluation["episodes"]) for evaluation in evaluations})

    def last_episodes(self, task: str) -> str:
        """Return the number of episodes of a task's last evaluations, which include those of the curves."""
        on_task = self.episodes[self.episodes["task"] == task]
        return _episodes(set(on_task.groupby("run_id").size().astype(int)))

    def budgets(self, task: str) -> dict[str, list[int]]:
        """Return the distinct numbers of environment steps that each controller's seeds were trained for."""
        return {name: sorted({row.env_steps for row in members}) for name, members in self.on(task).items()}

    @cached_property
    def rules(self) -> pd.DataFrame:
        """One row per episode of each rule that reports the metric."""
        played = self.runs.rules(print_rules_left_out)
        return played.dropna(subset=[self.column]) if self.column in played else played.iloc[:0]

    @cached_property
    def rules_beside_curves(self) -> dict[str, dict[str, float]]:
        """Mean of each rule over the evaluation episodes of the curves: task -> rule -> mean."""
        return rules_beside(self.runs, self.metric)

    @cached_property
    def best_rules(self) -> dict[str, str]:
        """Rule with the best mean over the last evaluation, by task; tasks without rules are absent."""
        ranked = {task: self.ranked_rules(task) for task in self.tasks}
        return {task: rules[0] for task, rules in ranked.items() if rules and not is_lookahead(rules[0])}

    @cached_property
    def scale(self) -> dict[str, tuple[float, float]]:
        """Mean values of the random rule and of the best rule on the curves' episodes, times `sign`, by task.

        Tasks without a rule better than the random one are absent.
        """
        found = {}
        for task, values in self.rules_beside_curves.items():
            signed = {rule: self.sign * value for rule, value in values.items() if not is_lookahead(rule)}
            if RANDOM in signed and max(signed.values()) > signed[RANDOM]:
                found[task] = (signed[RANDOM], max(signed.values()))
        return found

    def ranked_rules(self, task: str) -> list[str]:
        """Return the rules of a task, best first; `lookahead` after all others."""
        of_task = self.rules[self.rules["task"] == task]
        if of_task.empty:
            return []
        means = of_task.groupby("rule")[self.column].mean() * self.sign
        return sorted(map(str, means.sort_values(ascending=False).index), key=is_lookahead)

    def file_suffix(self, place: int) -> str:
        """Return the suffix of a file name if there is one file per task, such as `_1`."""
        return f"_{place + 1}" if len(self.tasks) > 1 else ""

    def of_controller(self, task: str, controller: str) -> pd.DataFrame:
        """Return the rows of `episodes` for a learner."""
        return self.episodes[(self.episodes["task"] == task) & (self.episodes["controller"] == controller)]

    def of_rule(self, task: str, rule: str) -> pd.DataFrame:
        """Return the rows of `rules` for a rule."""
        return self.rules[(self.rules["task"] == task) & (self.rules["rule"] == rule)]

    def by_seed(self, task: str, controller: str, column: str) -> pd.DataFrame:
        """Return a metric of the last evaluation: runs x episode seeds; empty if it was not logged."""
        of_cell = self.of_controller(task, controller)
        if column not in of_cell:
            return pd.DataFrame()
        return of_cell.pivot_table(index="run_id", columns="episode_seed", values=column)

    def by_episode(self, task: str, rule: str) -> "pd.Series[float]":
        """Return a rule's episodes by `episode_seed`."""
        return self.of_rule(task, rule).set_index("episode_seed")[self.column]

    def against_best_rule(self, task: str, controller: str) -> DifferenceFromBest:
        """Return the paired difference of the metric, learner minus the task's best rule.

        It is taken over the common episodes of the last evaluation and has a 95% interval; None, with the
        reason, if it is unknown.
        """
        if task not in self.best_rules:
            return DifferenceFromBest(None, "no rule was run")
        best = self.by_episode(task, self.best_rules[task])
        return self.paired(task, self.by_seed(task, controller, self.column), best)

    def gap_lines(self, task: str) -> list[str]:
        """Return the sentences of `comparison.gap_lines` for a task.

        They concern the controllers with a known difference from the best rule, over the episodes of the last
        evaluation that all learners, the best rule and `lookahead` have in common.
        """
        ranked = self.ranked_rules(task)
        known = [rule for rule in filter(is_lookahead, ranked) if self.rule_against_best(task, rule).interval]
        if not known:
            return []
        rules = {rule: self.by_episode(task, rule) for rule in (ranked[0], *known)}
        learned = {
            name: self.by_seed(task, name, self.column).mean(skipna=False)
            for name in self.on(task)
            if self.against_best_rule(task, name).interval
        }
        common = pd.concat([*rules.values(), *learned.values()], axis="columns").dropna().index
        if len(common) < 2:
            return []
        means = {name: float(values.loc[common].mean()) for name, values in learned.items()}
        played = {rule: values.loc[common].tolist() for rule, values in rules.items()}
        return gap_lines(means, played, self.sign)

    def rule_against_best(self, task: str, rule: str) -> DifferenceFromBest:
        """Return the paired difference of the metric, rule minus best rule; None for the best rule itself."""
        if task not in self.best_rules:
            return DifferenceFromBest(None, "no rule was run")
        if rule == self.best_rules[task]:
            return DifferenceFromBest(None)
        best = self.by_episode(task, self.best_rules[task])
        return self.paired(task, self.by_episode(task, rule).to_frame().T, best)

    @cached_property
    def learner_pairs(self) -> dict[str, list[PairRow]]:
        """Comparison of each pair of learners by task, on the episodes of the last evaluation that all
        learners of the task have in common; tasks for which it is unknown are absent."""
        found = {task: self._learner_pairs(task) for task in self.tasks}
        return {task: pairs for task, pairs in found.items() if pairs}

    def _learner_pairs(self, task: str) -> list[PairRow]:
        if self._several_roots(task):
            return []
        learned = {name: self.by_seed(task, name, self.column) for name in self.on(task)}
        return frames.pairs_on_common_episodes(self.column, learned)

    def _several_roots(self, task: str) -> bool:
        """Whether the evaluations of a task's runs had different episodes."""
        evaluations = (configuration(row.directory)["evaluation"] for row in self._runs_on(task))
        return len({int(evaluation["seed"]) for evaluation in evaluations}) > 1

    def paired(self, task: str, learned: pd.DataFrame, best: "pd.Series[float]") -> DifferenceFromBest:
        """Return a learner's values (as from `by_seed`) minus a rule's on their common episodes."""
        if self._several_roots(task):
            return DifferenceFromBest(None, "the cells were evaluated on different episodes")
        common = [seed for seed in learned.columns if seed in best.index]
        whole = learned[common].dropna(axis="columns")
        if whole.shape[1] < 2:
            return DifferenceFromBest(None, "fewer than two common episodes")
        return DifferenceFromBest(difference(whole.to_numpy().tolist(), best[whole.columns].tolist()))

    def _runs_on(self, task: str) -> list["RunRow"]:
        return [row for members in self.on(task).values() for row in members]

    @cached_property
    def metrics(self) -> list[str]:
        """Metrics logged for the evaluation episodes."""
        known = {*RUN_LABELS, *LABELS}
        return [
            str(name)
            for name in self.episodes.columns
            if name not in known and self.episodes[name].notna().any()
        ]

    @cached_property
    def summaries(self) -> pd.DataFrame:
        """Summary of each run, one row per run; energy columns are present even if nothing was measured."""
        found = self.runs.summaries().set_index("run_id")
        wanted = ["kwh", "kg_co2", "cpu_kwh", "gpu_kwh", "ram_kwh", "cpu_seconds"]
        for name in wanted:
            found[name] = pd.to_numeric(found[name]) if name in found else float("nan")
        return found


def _require_last_evaluation(directory: Path) -> None:
    """Raise HeadwayError if files of a finished run are damaged or lack the last evaluation."""
    require_results(directory)
    evaluated = read(directory, "evaluation", columns=["final"])
    if "final" not in evaluated or not evaluated["final"].any():
        raise HeadwayError(
            f"{directory} has no last evaluation in evaluation-*.parquet: restore it, or remove this run's "
            "folder"
        )


def _require_other_cells(runs: Sequence["RunRow"], others: Sequence["RunRow"]) -> None:
    """Raise HeadwayError if another study has runs of a cell of these studies."""
    studies = {row.cell: row.study for row in runs}
    for row in others:
        if row.cell in studies:
            raise HeadwayError(
                f"studies {studies[row.cell]} and {row.study} both have runs of {row.cell}, with the same "
                "settings: a report cannot tell them apart, but `headway compare` can"
            )


def _stage_ends(config: Mapping[str, Any]) -> tuple[int, ...]:
    iteration_steps = steps_per_iteration(config)
    lengths = [stage["env_steps"] for stage in config.get("stages") or ()]
    return tuple(last * iteration_steps for last in last_iterations(lengths[:-1], iteration_steps))


def _episodes(numbers: set[int]) -> str:
    return counted(numbers.pop(), "episode") if len(numbers) == 1 else "differing numbers of episodes"
