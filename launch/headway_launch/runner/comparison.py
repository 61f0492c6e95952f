"""Comparison of trained policies with the classical rules on the same evaluation episodes."""

import math
import sys
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from statistics import fmean
from typing import TYPE_CHECKING, NamedTuple, Self

from headway.contracts.errors import HeadwayError
from headway.events import LABELS, Row
from headway.registry import rule_entry
from headway.rollout.lookahead import is_lookahead
from headway.wording import readable_metric
from headway_launch.console.number_formats import MISSING, formatted, with_ends
from headway_launch.console.output import print_line, prints_to_stderr
from headway_launch.console.tables import Value, print_table

if TYPE_CHECKING:
    from headway.rollout.episodes import OnStep
    from headway.stats.samples import Interval
    from headway_launch.console.progress_display import CountedProgress
    from headway_launch.experiments.compose import Experiment, PreparedEnv

_RULE = "rule "
_METRICS_SHOWN = 3
"""Metrics beside the return in the table at the end of a training."""
_WHOLE_NAME = 30
"""Length up to which names of controllers are not wrapped, at the expense of metrics."""
_ROUNDING = 1e-12
"""Largest width of an interval, relative to its ends, that rounding alone explains."""
SEEDS_FOR_A_CLAIM = 10
"""Minimum number of training seeds from which an interval over seeds that excludes 0 supports a claim."""
EPISODES_FOR_A_CLAIM = 20
"""Minimum number of episodes from which an interval over episodes that excludes 0 supports a claim."""


def rules_to_play(environment: "PreparedEnv", names: str | None, option: str = "--rules") -> tuple[str, ...]:
    """Return the rules to play: the distinct ones in `names` (`a,b`) or, by default, all that can be played
    except `lookahead`.

    Prints which rules are left out because wrappers hide their inputs. Raises HeadwayError, naming `option`,
    for an unknown rule or a listed rule that cannot play.
    """
    known = environment.entry.rules
    if names is not None:
        wanted = tuple(dict.fromkeys(name.strip() for name in names.split(",") if name.strip()))
        for name in wanted:
            if problem := _refusal(environment, name):
                raise HeadwayError(f"{option}: {problem}")
        return wanted
    problems = {name: problem for name in known if (problem := _refusal(environment, name))}
    if problems:
        others = f" (likewise {', '.join(list(problems)[1:])})" if len(problems) > 1 else ""
        print_line(f"headway: left out: {next(iter(problems.values()))}{others}")
    return tuple(name for name in known if name not in problems)


def _refusal(environment: "PreparedEnv", rule: str) -> str | None:
    """Return why a rule is unknown or cannot play an environment; None if it can."""
    try:
        rule_entry(environment.entry, rule).make(environment.prepared)
    except HeadwayError as error:
        return str(error)
    return None


@prints_to_stderr()
def rule_episodes(
    experiment: "Experiment",
    prepared: object,
    rules: Sequence[str],
    root: int,
    episodes: int,
    progress: "CountedProgress",
) -> dict[str, list[Row]]:
    """Return the episodes of each rule, one row per episode, on the evaluation seeds derived from `root`."""
    from headway.rollout.episodes import evaluate_rule

    env = experiment.env
    return {
        rule: evaluate_rule(
            env.make, rule_entry(env, rule).make, prepared, root, episodes, counting(progress, f"rule {rule}")
        )
        for rule in rules
    }


def counting(progress: "CountedProgress", name: str) -> "OnStep":
    """Return a callback that adds the finished episodes of the controller `name` to the counter."""
    return lambda step, ended: progress.add(ended, f"{name}, step {step:,}")


class ComparisonRow(NamedTuple):
    """One metric of one controller. None: a rule has no seeds, the reference no difference from itself."""

    metric: str
    controller: str
    seeds: int | None
    mean: float
    difference: float | None = None
    """Controller minus reference; None also for metrics that are not compared."""
    low: float | None = None
    high: float | None = None
    interval: str | None = None
    """Kind of the 95% interval of the difference, from `low` to `high`; None: only one episode was played."""


@dataclass(frozen=True)
class Comparison:
    """Controllers compared on the same episodes."""

    title: str
    reference: str | None
    """The rule from which differences are; None if no rule was played."""
    metrics: Mapping[str, str]
    """Their names in words."""
    rows: Sequence[ComparisonRow]
    """Per metric: learners, then rules by their mean return."""
    episodes: int = 0
    """Number of episodes that each policy and each rule played."""

    @classmethod
    def of(
        cls,
        title: str,
        described: Mapping[str, str],
        rules: Mapping[str, Sequence[Row]],
        learned: Mapping[str, Sequence[Sequence[Row]]],
        names: Sequence[str] = (),
        reference: str | None = None,
    ) -> Self:
        """Compare episodes. `rules`: episodes of each; `learned`: seeds x episodes of each.

        `described`: descriptions of the environment's metrics; `names`: those to compare, by default the
        return, beside which stand the means of the first metrics that all episodes have. `reference`: by
        default the best rule.
        """
        by_return = sorted(rules, key=lambda rule: -fmean(metric_values(rules[rule], "return")))
        if reference is None and rules:
            reference = min(by_return, key=is_lookahead)  # the first; `lookahead` only if there is no other
        controllers = {**learned, **{f"{_RULE}{rule}": [rules[rule]] for rule in by_return}}
        compared, names = names or ("return",), names or _first_metrics(controllers.values())
        rows = []
        for metric in names:
            for name, by_seed in controllers.items():
                values = [metric_values(of_seed, metric) for of_seed in by_seed]
                seeds = len(values) if name in learned else None
                row = ComparisonRow(metric, name, seeds, fmean(map(fmean, values)))
                if reference is not None and metric in compared and name != f"{_RULE}{reference}":
                    of_reference = metric_values(rules[reference], metric)
                    if len(of_reference) > 1:
                        found = difference(values, of_reference)
                        row = ComparisonRow(*row[:4], found.estimate, found.low, found.high, found.method)
                    else:
                        row = row._replace(difference=row.mean - of_reference[0])
                rows.append(row)
        metrics = {name: readable_metric(name, described.get(name, "")) for name in names}
        return cls(
            title,
            reference,
            metrics,
            rows,
            min((len(each[0]) for each in controllers.values() if each), default=0),
        )

    @property
    def controllers(self) -> list[str]:
        """Names of the rows of a page."""
        return list(dict.fromkeys(row.controller for row in self.rows))

    @property
    def headings(self) -> list[str]:
        """Headings of `cells`."""
        minus = f"minus {self.reference}" + " [95%]" * any(row.low is not None for row in self.rows)
        compared = self._compared
        words = (
            word
            for key, name in self.metrics.items()
            for word in (name, *((minus,) if key in compared else ()))
        )
        return ["controller", "seeds", *words]

    @property
    def cells(self) -> list[list[str]]:
        """One row per controller, formatted; a metric has a column for its means and one for differences."""
        decimals, compared = self._decimals, self._compared
        cells: dict[str, list[str]] = {}
        for row in self.rows:
            first = [row.controller, MISSING if row.seeds is None else str(row.seeds)]
            texts = cells.setdefault(row.controller, first)
            digits = decimals.get(row.metric)
            texts.append(formatted(row.mean, digits))
            if row.metric in compared:
                ends = [formatted(end, digits) for end in (row.low, row.high) if end is not None]
                interval = f" [{', '.join(ends)}]" if ends else ""
                texts.append(formatted(row.difference, digits, "+") + interval)
        return list(cells.values())

    @property
    def _compared(self) -> set[str]:
        """Metrics with differences from the reference."""
        return {row.metric for row in self.rows if row.difference is not None}

    @property
    def _decimals(self) -> dict[str, int]:
        """Decimals that show two significant digits of a metric's narrowest interval, and no end as 0."""
        found = defaultdict[str, list[tuple[float, float]]](list)
        for row in self.rows:
            low, high = row.low or 0.0, row.high or 0.0
            # The interval of equal differences is as wide as the rounding of their sum.
            if high - low > _ROUNDING * max(abs(low), abs(high)):
                found[row.metric].append((low, high))
        digits = {
            metric: 1 - math.floor(math.log10(min(high - low for low, high in ends)))
            for metric, ends in found.items()
        }
        return {metric: with_ends(digits[metric], chain(*ends)) for metric, ends in found.items()}

    def numbers(self) -> tuple[list[str], list[list[Value]]]:
        """Return the columns and rows of a table for programs: as `cells`, with three per difference."""
        compared = self._compared
        columns = ["controller", "seeds"]
        for metric in self.metrics:
            columns.append(metric)
            if metric in compared:
                name = f"{metric} " if len(compared) > 1 else ""
                columns += [f"{name}minus {self.reference}", f"{name}95% low", f"{name}95% high"]
        table: dict[str, list[Value]] = {}
        for row in self.rows:
            values = (row.mean, row.difference, row.low, row.high)[: 4 if row.metric in compared else 1]
            table.setdefault(row.controller, [row.controller, row.seeds]).extend(values)
        return columns, list(table.values())

    @property
    def answer(self) -> str | None:
        """The sentence on the best learner and the reference; None without a learner, a rule or returns."""
        of_return = [row for row in self.rows if row.metric == "return"]
        learners = [row for row in of_return if row.seeds is not None]
        if not learners or self.reference is None:
            return None
        best, digits = max(learners, key=lambda row: row.mean), self._decimals.get("return")
        assert best.difference is not None
        rules = [row for row in of_return if row.seeds is None and not is_lookahead(_rule(row))]
        is_best = len(rules) > 1 and _rule(rules[0]) == self.reference
        reference = f"the {'best rule, ' if is_best else 'rule '}{self.reference}"
        who = f"{best.controller}, {'1 seed' if best.seeds == 1 else f'mean of {best.seeds} seeds'}"
        who += f", the best of {len(learners)} learners" if len(learners) > 1 else ""
        interval = ""
        if best.low is not None and best.high is not None:
            interval = f" [95%: {formatted(best.low, digits)}, {formatted(best.high, digits)}]"
            if best.low <= 0 <= best.high:
                by = formatted(best.difference, digits, "+")
                return f"return: {who}, does not differ significantly from {reference}: {by}{interval}"
        by = formatted(abs(best.difference), digits)
        enough = (best.seeds or 0) >= SEEDS_FOR_A_CLAIM and self.episodes >= EPISODES_FOR_A_CLAIM
        if enough and best.low is not None and best.low > 0:
            return f"return: {who}, beats {reference}, by {by}{interval}"
        way = "above" if best.difference > 0 else "below"
        return f"return: {who}, is {by} {way} {reference}{interval}"

    def show(self) -> None:
        """Print one row per controller; on a terminal, differences of several metrics in a table each."""
        if not sys.stdout.isatty():
            print_table(*self.numbers())
            return
        groups = [[metric] for metric in self.metrics] if len(self._compared) > 1 else [list(self.metrics)]
        for group in groups:
            shown = {metric: self.metrics[metric] for metric in group}
            part = replace(self, metrics=shown, rows=[row for row in self.rows if row.metric in shown])
            headings = part.headings
            whole = headings[:1] if max(map(len, self.controllers)) <= _WHOLE_NAME else ()
            print_table(headings, part.cells, self.title, whole, headings[:3:-1], headings[1:])


def _rule(row: ComparisonRow) -> str:
    return row.controller.removeprefix(_RULE)


def metric_values(episodes: Sequence[Row], metric: str) -> list[float]:
    """Return a metric of each episode."""
    return [float(row[metric]) for row in episodes]


def mean_return(learned: Sequence[Sequence[Row]]) -> float:
    """Return the mean return of a learner, seeds x episodes."""
    return fmean(fmean(metric_values(rows, "return")) for rows in learned)


def _first_metrics(played: Iterable[Sequence[Sequence[Row]]]) -> list[str]:
    """Return the return and the first metrics that all episodes have."""
    first, *others = (row for by_seed in played for rows in by_seed for row in rows)
    names = [name for name in first if name not in LABELS | {"length", "return"}]
    everywhere = [name for name in names if all(row.get(name) is not None for row in (first, *others))]
    return ["return", *everywhere[:_METRICS_SHOWN]]


def print_findings(
    found: Comparison, learned: Mapping[str, Sequence[Sequence[Row]]], rules: Mapping[str, Sequence[Row]]
) -> None:
    """Print the answer of a comparison, gaps to `lookahead`, and what the numbers are too few for."""
    if answer := found.answer:
        print_line(answer)
    means = {name: mean_return(of_cell) for name, of_cell in learned.items()}
    for line in gap_lines(means, {rule: metric_values(rows, "return") for rule, rows in rules.items()}):
        print_line(line)
    if not rules or len(rules) + len(learned) < 2:
        return
    episodes, seeds = len(next(iter(rules.values()))), min(map(len, learned.values()), default=0)
    if 0 < seeds < SEEDS_FOR_A_CLAIM and (seeds > 1 or episodes > 1):
        print_line(few_seeds(seeds))
    if episodes < EPISODES_FOR_A_CLAIM:
        print_line(few_episodes(episodes))


def difference(learned: Sequence[Sequence[float]], rule: Sequence[float]) -> "Interval":
    """Return the paired difference of a metric between a learner (seeds x episodes) and a rule (episodes).

    The 95% interval is Student's t over episodes for one seed, over seeds and episodes for more. Raises
    ValueError for fewer than two episodes.
    """
    from headway.stats.intervals import paired_difference, paired_difference_over_seeds

    if len(learned) == 1:
        return paired_difference(learned[0], rule)
    return paired_difference_over_seeds(learned, [rule] * len(learned))


def gap_lines(learned: Mapping[str, float], rules: Mapping[str, Sequence[float]], sign: int = 1) -> list[str]:
    """Return a sentence for each `lookahead` among the rules on its lead over the best other rule.

    It states which share of that lead each learner reaches, if the paired 95% interval of the lead over
    episodes is above 0. `learned`: mean of each learner; `rules`: values of each rule, of the same episodes
    in the same order. `sign` is -1 if lower is better.
    """
    others = [rule for rule in rules if not is_lookahead(rule)]
    if not others:
        return []
    best = max(others, key=lambda rule: sign * fmean(rules[rule]))
    means = {name: sign * (value - fmean(rules[best])) for name, value in learned.items()}
    gained = {
        reference: [sign * (value - of_best) for value, of_best in zip(values, rules[best], strict=True)]
        for reference, values in rules.items()
        if is_lookahead(reference)
    }
    return [_gap_line(best, reference, values, means) for reference, values in gained.items()]


def _gap_line(best: str, reference: str, gains: Sequence[float], learned: Mapping[str, float]) -> str:
    """Return the sentence on one `lookahead`; `gains` (episodes,) and `learned` are differences from the rule
    `best`."""
    between = f"gap from {best}, the best of the rules played, to {reference}"
    if len(gains) < 2:
        return f"{between}: not distinguishable from 0 over fewer than two episodes"
    gap = difference([gains], [0.0] * len(gains))
    interval = f"95% interval {gap.low:.4g} to {gap.high:.4g}"
    if gap.low <= 0:
        finding = "not distinguishable from 0" if gap.high >= 0 else f"none, {reference} is worse"
        return f"{between}: {finding} ({interval})"
    shares = ", ".join(f"{name} closes {value / gap.estimate:.0%}" for name, value in learned.items())
    note = "a reference that simulates the environment"
    return f"{between}, {note}: {gap.estimate:.4g} ({interval}){'; of this gap, ' if shares else ''}{shares}"


def few_seeds(seeds: int) -> str:
    """Return a warning about a comparison over few training seeds."""
    if seeds == 1:
        limit = "1 seed: the interval is over episodes of one policy and ignores the variation between seeds"
    else:
        limit = f"{seeds} seeds: the interval assumes a normal distribution and may miss rare failures"
    return f"{limit}; train at least {SEEDS_FOR_A_CLAIM} before claiming that one is better"


def few_episodes(episodes: int) -> str:
    """Return a warning about a comparison over few episodes."""
    if episodes == 1:
        return f"1 episode: no intervals, which need two; play at least {EPISODES_FOR_A_CLAIM} for a claim"
    return (
        f"{episodes} episodes: the intervals assume a normal distribution and may miss rare episodes; "
        f"play at least {EPISODES_FOR_A_CLAIM} before claiming that one is better"
    )
