"""The comparison of learners and rules that `headway compare` prints, and its table for a page or a paper."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from headway_launch.console.tables import Value
from headway_launch.report.elements import MISSING, Table, formatted


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

    @property
    def columns(self) -> tuple[str, ...]:
        """Headings of the rows' values."""
        difference = f"minus {self.reference}"
        return ("metric", "controller", "seeds", "mean", difference, "95% low", "95% high", "interval")

    @property
    def decimals(self) -> dict[str, int]:
        """Decimals of each metric that show two significant digits of its narrowest interval."""
        widths: dict[str, float] = {}
        for row in self.rows:
            if row.low is not None and row.high is not None and row.high > row.low:
                widths[row.metric] = min(widths.get(row.metric, math.inf), row.high - row.low)
        return {metric: 1 - math.floor(math.log10(width)) for metric, width in widths.items()}

    def records(self) -> list[dict[str, Value]]:
        """Return the values of each row by column."""
        return [dict(zip(self.columns, row, strict=True)) for row in self.rows]

    def rounded(self) -> list[tuple[Value, ...]]:
        """Return the rows with numbers rounded to `decimals`."""
        decimals = self.decimals

        def rounded(metric: str, value: Value) -> Value:
            if not isinstance(value, float) or metric not in decimals:
                return value
            return round(value, decimals[metric]) + 0.0  # no -0.0

        return [tuple(rounded(row.metric, value) for value in row) for row in self.rows]


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
        f"{comparison.title}. Differences from the rule `{reference}` are paired by episode, with 95% "
        "intervals by Student's t: over training seeds and episodes for several seeds, over episodes for one "
        "seed or a rule." + note,
        ["controller", "seeds", *(word for name in names for word in (name, f"minus {reference} [95%]"))],
        cells,
        emphasised=frozenset(range(learners, len(cells))),
    )
