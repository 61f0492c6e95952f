"""Words and tables on a comparison of trained policies with rules on the same evaluation episodes."""

import math
import sys
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from typing import Self

from headway.contracts.entries import is_lookahead
from headway.events import Row
from headway.stats.comparison import (
    EPISODES_FOR_A_CLAIM,
    RULE,
    SEEDS_FOR_A_CLAIM,
    ComparisonRow,
    Gap,
    best_learner,
    best_rule,
    comparison_rows,
    gaps,
    mean_return,
    metric_values,
)
from headway.wording import readable_metric
from headway_launch.console.number_formats import MISSING, formatted, with_ends
from headway_launch.console.output import print_line
from headway_launch.console.tables import print_table

_WHOLE_NAME = 30
"""Length up to which names of controllers are not wrapped, at the expense of metrics."""
_ROUNDING = 1e-12
"""Largest width of an interval, relative to its ends, that rounding alone explains."""


@dataclass(frozen=True)
class Comparison:
    """Controllers compared on the same episodes, in words and digits."""

    title: str
    reference: str | None
    """The rule from which differences are; None if no rule was played."""
    metrics: Mapping[str, str]
    """Their names in words."""
    rows: Sequence[ComparisonRow]
    """Per metric: learners, then rules by their mean return."""
    episodes: int = 0
    """Number of episodes that each policy and each rule played."""
    best: ComparisonRow | None = None
    """The best learner's difference of returns, by `best_learner`; None without learners or rules."""

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
        """Compare episodes; arguments as in `headway.stats.comparison.comparison_rows`.

        `described`: descriptions of the environment's metrics; `reference`: by default the best rule.
        """
        if reference is None:
            reference = best_rule(rules)
        rows = comparison_rows(rules, learned, names, reference)
        metrics = {row.metric: readable_metric(row.metric, described.get(row.metric, "")) for row in rows}
        played = [*rules.values(), *(by_seed[0] for by_seed in learned.values() if by_seed)]
        best = best_learner(rules, learned, reference) if learned and reference is not None else None
        return cls(title, reference, metrics, rows, min(map(len, played), default=0), best)

    @property
    def controllers(self) -> list[str]:
        """Names of the rows of a page."""
        return list(dict.fromkeys(row.controller for row in self.rows))

    def headings(self, whole: bool = False) -> list[str]:
        """Return the headings of `cells`. `whole`: a difference's begins with its metric, so all differ."""
        minus = f"minus {self.reference}" + " [95%]" * any(row.low is not None for row in self.rows)
        compared = self._compared
        words = (
            word
            for key, name in self.metrics.items()
            for word in (name, *((f"{name} {minus}" if whole else minus,) if key in compared else ()))
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

    @property
    def answer(self) -> str | None:
        """The sentence on the best learner and the reference; None without a learner, a rule or returns."""
        of_return = [row for row in self.rows if row.metric == "return"]
        learners = [row for row in of_return if row.seeds is not None]
        best, digits = self.best, self._decimals.get("return")
        if not learners or best is None:
            return None
        assert best.difference is not None
        rules = [row for row in of_return if row.seeds is None and not is_lookahead(_rule(row))]
        is_best = len(rules) > 1 and _rule(rules[0]) == self.reference
        reference = f"the {'best rule, ' if is_best else 'rule '}{self.reference}"
        who = f"{best.controller}, {'1 seed' if best.seeds == 1 else f'mean of {best.seeds} seeds'}"
        who += f", the best of {len(learners)} learners" if len(learners) > 1 else ""
        interval = ""
        if best.low is not None and best.high is not None:
            ends = formatted(best.low, digits), formatted(best.high, digits)
            corrected = ", corrected for choosing the best" if len(learners) > 1 else ""
            interval = f" [95%{corrected}: {', '.join(ends)}]"
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
            headings = self.headings(whole=True)
            print_table(headings, self.cells, numbers=headings[1:])
            return
        groups = [[metric] for metric in self.metrics] if len(self._compared) > 1 else [list(self.metrics)]
        for group in groups:
            shown = {metric: self.metrics[metric] for metric in group}
            part = replace(self, metrics=shown, rows=[row for row in self.rows if row.metric in shown])
            headings = part.headings()
            whole = headings[:1] if max(map(len, self.controllers)) <= _WHOLE_NAME else ()
            print_table(headings, part.cells, self.title, whole, headings[:3:-1], headings[1:])


def _rule(row: ComparisonRow) -> str:
    return row.controller.removeprefix(RULE)


def print_env_changes(changes: Sequence[str]) -> None:
    """Print what differs between the environments of training and evaluation; nothing without changes."""
    if changes:
        print_line(f"headway: evaluated on a changed environment: {'; '.join(changes)}")


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


def gap_lines(learned: Mapping[str, float], rules: Mapping[str, Sequence[float]], sign: int = 1) -> list[str]:
    """Return a sentence for each gap found by `headway.stats.comparison.gaps`, whose arguments these are."""
    return [_gap_line(gap) for gap in gaps(learned, rules, sign)]


def _gap_line(gap: Gap) -> str:
    between = f"gap from {gap.best}, the best of the rules played, to {gap.reference}"
    lead = gap.lead
    if lead is None:
        return f"{between}: not distinguishable from 0 over fewer than two episodes"
    interval = f"95% interval {lead.low:.4g} to {lead.high:.4g}"
    if lead.low <= 0:
        finding = "not distinguishable from 0" if lead.high >= 0 else f"none, {gap.reference} is worse"
        return f"{between}: {finding} ({interval})"
    shares = ", ".join(f"{name} closes {share:.0%}" for name, share in gap.shares.items())
    note = "a reference that simulates the environment"
    return f"{between}, {note}: {lead.estimate:.4g} ({interval}){'; of this gap, ' if shares else ''}{shares}"


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
