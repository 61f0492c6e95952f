"""Comparisons of learners with rules and with each other, and their tables for a page or a paper."""

import math
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from statistics import fmean
from typing import TYPE_CHECKING, NamedTuple

from headway_launch.console.number_formats import MISSING, formatted, with_interval
from headway_launch.console.tables import Value
from headway_launch.report.elements import Table
from headway_launch.runner.comparison import difference
from headway_launch.studies.learner_pairs import PairRow, pairs_note

if TYPE_CHECKING:
    from headway.events import Row

PAIR_COLUMNS = (
    *("metric", "learner", "minus learner", "difference", "95% low", "95% high"),
    *("p", "p (Holm)", "seeds needed"),
)
_ROUNDING = 1e-12
"""Largest width of an interval, relative to its ends, that rounding alone explains."""
RECORD_COLUMNS = (
    *("metric", "controller", "seeds", "mean", "reference", "difference", "95% low", "95% high", "interval"),
    *("p", "p (Holm)", "seeds needed"),
)


class ComparisonRow(NamedTuple):
    """One metric of one controller. None: a rule has no seeds, the reference no difference from itself."""

    metric: str
    controller: str
    seeds: int | None
    mean: float
    difference: float | None = None
    """Controller minus reference."""
    low: float | None = None
    high: float | None = None
    interval: str | None = None
    """Kind of the 95% interval of the difference, from `low` to `high`."""


def comparison_rows(
    metrics: Sequence[str],
    rules: Mapping[str, Sequence["Row"]],
    learned: Mapping[str, Sequence[Sequence["Row"]]],
    reference: str,
) -> list[ComparisonRow]:
    """Return the rows of a comparison. `rules`: episodes of each; `learned`: seeds x episodes of each."""
    controllers = {**{f"rule {rule}": [episodes] for rule, episodes in rules.items()}, **learned}
    rows = []
    for metric in metrics:
        of_reference = metric_values(rules[reference], metric)
        for name, by_seed in controllers.items():
            values = [metric_values(of_seed, metric) for of_seed in by_seed]
            row = ComparisonRow(
                metric, name, len(values) if name in learned else None, fmean(map(fmean, values))
            )
            if name != f"rule {reference}":
                found = difference(values, of_reference)
                row = row._replace(
                    difference=found.estimate, low=found.low, high=found.high, interval=found.method
                )
            rows.append(row)
    return rows


def metric_values(episodes: Sequence["Row"], metric: str) -> list[float]:
    """Return a metric of each episode."""
    return [float(row[metric]) for row in episodes]


@dataclass(frozen=True)
class Comparison:
    """Controllers compared on the same episodes."""

    title: str
    reference: str
    metrics: Mapping[str, str]
    """Their names in words."""
    controllers: Sequence[str]
    """In the order of a page: learners, then rules by their mean return."""
    rows: Sequence[ComparisonRow]
    pairs: Sequence[PairRow] = ()
    """Pairs of learners, by the first metric."""

    @property
    def columns(self) -> tuple[str, ...]:
        """Headings of the rows' values."""
        difference = f"minus {self.reference}"
        return ("metric", "controller", "seeds", "mean", difference, "95% low", "95% high", "interval")

    @property
    def decimals(self) -> dict[str, int]:
        """Decimals of each metric that show two significant digits of its narrowest interval."""
        return _decimals((row.metric, row.low, row.high) for row in self.rows)

    def records(self) -> list[dict[str, Value]]:
        """Return each difference from the reference, then of each pair of learners, with all digits."""
        means = {(row.metric, row.controller): row for row in self.rows}
        records: list[dict[str, Value]] = []
        for row in self.rows:
            reference = None if row.difference is None else f"rule {self.reference}"
            values = (*row[:4], reference, *row[4:], None, None, None)
            records.append(dict(zip(RECORD_COLUMNS, values, strict=True)))
        for pair in self.pairs:
            found = pair.difference.interval
            compared = (
                *means[pair.metric, pair.a][:4],
                *(pair.b, found.estimate, found.low, found.high, found.method),
                *(pair.difference.p_value, pair.corrected_p, pair.needed),
            )
            records.append(dict(zip(RECORD_COLUMNS, compared, strict=True)))
        return records

    def rounded_pairs(self) -> list[tuple[Value, ...]]:
        """Return the values of `PAIR_COLUMNS`, rounded as those of `rounded`."""
        found = [pair.difference.interval for pair in self.pairs]
        decimals = _decimals(
            (pair.metric, each.low, each.high) for pair, each in zip(self.pairs, found, strict=True)
        )
        return [
            (
                *(pair.metric, pair.a, pair.b),
                *(
                    _rounded(value, decimals.get(pair.metric))
                    for value in (each.estimate, each.low, each.high)
                ),
                *pair.p_texts,
                pair.needed,
            )
            for pair, each in zip(self.pairs, found, strict=True)
        ]

    def rounded(self) -> list[tuple[Value, ...]]:
        """Return the rows rounded to one digit more than `decimals`: shown means differ by what is shown."""
        decimals = self.decimals
        return [
            tuple(
                _rounded(value, decimals.get(row.metric)) if isinstance(value, float) else value
                for value in row
            )
            for row in self.rows
        ]


def _decimals(intervals: Iterable[tuple[str, float | None, float | None]]) -> dict[str, int]:
    """Return the decimals of each metric that show two significant digits of its narrowest interval.

    One more if an end that is not 0 would be shown as 0, so that it is seen whether the interval excludes 0.
    """
    found = defaultdict[str, list[tuple[float, float]]](list)
    for metric, low, high in intervals:
        # The interval of equal differences is as wide as the rounding of their sum.
        if low is not None and high is not None and high - low > _ROUNDING * max(abs(low), abs(high)):
            found[metric].append((low, high))
    decimals = {}
    for metric, ends in found.items():
        digits = 1 - math.floor(math.log10(min(high - low for low, high in ends)))
        hidden = any(end and round(end, digits) == 0 for pair in ends for end in pair)
        decimals[metric] = digits + hidden
    return decimals


def _rounded(value: float, decimals: int | None) -> float:
    return value if decimals is None else round(value, decimals + 1) + 0.0  # no -0.0


def comparison_table(comparison: Comparison, note: str = "") -> Table:
    """Return a comparison as a table with one row per controller and two columns per metric.

    `note`: end of its caption.
    """
    decimals = comparison.decimals
    rows = {(row.metric, row.controller): row for row in comparison.rows}

    def shown(row: ComparisonRow) -> list[str]:
        digits = decimals.get(row.metric)
        ends = [formatted(end, digits) for end in (row.low, row.high) if end is not None]
        interval = f" [{', '.join(ends)}]" if ends else ""
        return [formatted(row.mean, digits), formatted(row.difference, digits, "+") + interval]

    cells: list[list[str]] = []
    for controller in comparison.controllers:
        of_controller = [rows[metric, controller] for metric in comparison.metrics]
        seeds = of_controller[0].seeds
        values = [text for row in of_controller for text in shown(row)]
        cells.append([controller, MISSING if seeds is None else str(seeds), *values])
    reference, names = comparison.reference, comparison.metrics.values()
    learners = sum(not name.startswith("rule ") for name in comparison.controllers)
    return Table(
        "comparison",
        f"{comparison.title}. Differences from the rule `{reference}`, paired by episode, with 95% intervals "
        "(Student's t). Intervals of several seeds cover the variation between seeds and between episodes, "
        "those of one seed or of a rule only that between episodes." + note,
        ["controller", "seeds", *(word for name in names for word in (name, f"minus {reference} [95%]"))],
        cells,
        emphasised=frozenset(range(learners, len(cells))),
    )


def pairs_table(pairs: Sequence[PairRow], name: str, caption: str) -> Table:
    """Return pairs of learners as a table with one row per pair; `caption` is continued by `pairs_note`."""
    import pandas as pd

    cells, exact = [], []
    for pair in pairs:
        found = pair.difference.interval
        shown = with_interval(found.estimate, found.low, found.high, sign="+")
        needed = MISSING if pair.needed is None else str(pair.needed)
        cells.append([pair.a, pair.b, shown, *pair.p_texts, needed])
        exact.append(
            {
                "controller": pair.a,
                "minus": pair.b,
                "difference": found.estimate,
                "low": found.low,
                "high": found.high,
                "interval": found.method,
                "p": pair.difference.p_value,
                "p_holm": pair.corrected_p,
                "seeds_needed": pair.seeds_needed,
            }
        )
    headings = ["controller", "minus", "difference [95%]", "p", "p (Holm)", "seeds needed"]
    caption = f"{caption}. {pairs_note(pairs)}."
    return Table(name, caption, headings, cells, pd.DataFrame(exact), words=frozenset({0, 1}))
