"""A report and its parts: sections of paragraphs, tables, pictures and listings; formatting of numbers.

The modules `html_page`, `markdown_page` and `latex_table` render them.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

MISSING = "\N{EN DASH}"
_DIGITS = 4


@dataclass(frozen=True)
class Table:
    """A table: formatted text for display, and the same values with all digits."""

    name: str
    """Name of its files, without suffix."""
    caption: str
    headings: Sequence[str]
    rows: Sequence[Sequence[str]]
    """Formatted cells; the first column names the row."""
    data: "pd.DataFrame | None" = None
    """Values with all digits for its CSV; None if it has none."""
    words: frozenset[int] = frozenset({0})
    """Columns of text; the others hold numbers."""
    emphasised: frozenset[int] = frozenset()
    """Rows of classical rules, set apart from learners."""
    per_run: bool = False
    """Has a row per run: a page of Markdown links its CSV instead of showing it."""

    def file(self, suffix: str) -> str:
        """Return the path of its file in the report's folder."""
        return f"tables/{self.name}.{suffix}"

    @property
    def exact(self) -> "pd.DataFrame":
        """`data` of a table that has a CSV."""
        assert self.data is not None
        return self.data


def table_by_task(
    tasks: Sequence[str],
    name: str,
    caption: str,
    headings: Sequence[str],
    rows: Sequence[Sequence[str]],
    data: "pd.DataFrame",
    words: Sequence[int] = (),
    emphasised: frozenset[int] = frozenset(),
) -> Table:
    """Return a `Table` of rows that begin with their task and controller; `words`: other columns of text.

    If the study has only one of `tasks`, its column is left out; `headings` are those of the other columns.
    """
    left_out = int(len(tasks) == 1)
    of_text = frozenset(column - left_out for column in (left_out, 1, *words))
    headings = ["environment", *headings][left_out:]
    return Table(name, caption, headings, [row[left_out:] for row in rows], data, of_text, emphasised)


@dataclass(frozen=True)
class Picture:
    """A picture with its caption."""

    name: str
    """Name of its file, without suffix."""
    caption: str
    figure: "Figure"

    def file(self, suffix: str) -> str:
        """Return the path of its file in the report's folder."""
        return f"pictures/{self.name}.{suffix}"


@dataclass(frozen=True)
class Listing:
    """Preformatted text under a title, which can be folded."""

    title: str
    text: str
    file: str = ""
    """Path in the report's folder of a file with the text; empty: none."""
    unfolded: bool = False


Part = str | Table | Picture | Listing
"""A string is a paragraph; text between backquotes is code."""


@dataclass(frozen=True)
class Section:
    """A section of the page with a heading."""

    anchor: str
    title: str
    body: list[Part] = field(default_factory=list)


@dataclass(frozen=True)
class Report:
    """Contents of a report."""

    title: str
    subtitle: str
    summary: Sequence[str]
    """Sentences of the summary at the top."""
    sections: Sequence[Section]
    command: str
    """Command that makes the report."""
    footer: str


def text_and_code(text: str) -> list[tuple[str, bool]]:
    """Split a paragraph into its pieces; the flag is True for code."""
    return [(piece, place % 2 == 1) for place, piece in enumerate(text.split("`"))]


def formatted(value: float | None, decimals: int | None = None, sign: str = "") -> str:
    """Format a number to `decimals`, or to four significant digits, whole parts in full; a dash if unknown.

    `sign` is "+" to write that of positive numbers and of zero; zero is never negative.
    """
    if value is None or not math.isfinite(value):
        return MISSING
    if decimals is not None:
        return f"{round(value, decimals):{sign}z,.{max(decimals, 0)}f}"
    if value == int(value) and abs(value) < 1e15:
        return f"{int(value):{sign},}"
    if abs(value) < 1e-4:
        return f"{value:{sign}.{_DIGITS - 1}e}"
    return formatted(value, max(_DIGITS - 1 - math.floor(math.log10(abs(value))), 0), sign)


def with_deviation(mean: float, deviation: float, decimals: int | None = None) -> str:
    """Format as `71.28 ± 0.15`, or without the deviation if it is unknown."""
    if not math.isfinite(mean):
        return MISSING
    if decimals is None:
        decimals = _decimals(deviation if math.isfinite(deviation) else 0.0, mean)
    if not math.isfinite(deviation):
        return formatted(mean, decimals)
    return f"{formatted(mean, decimals)} ± {formatted(deviation, decimals)}"


def with_interval(estimate: float, low: float, high: float, sign: str = "") -> str:
    """Format as `20.5 [15.4, 25.7]`, or without the interval if it is unknown; `sign`: of `formatted`."""
    if not math.isfinite(estimate):
        return MISSING
    if not (math.isfinite(low) and math.isfinite(high)):
        return formatted(estimate, _decimals(0.0, estimate), sign)
    decimals = _decimals(high - low, estimate)
    return f"{formatted(estimate, decimals, sign)} [{formatted(low, decimals)}, {formatted(high, decimals)}]"


def scale_of(largest: float, unit: str) -> tuple[str, float]:
    """Return a readable unit for values up to `largest` and the factor to it: (`mWh`, 1e6) for 3e-5 kWh.

    `unit` must begin with k.
    """
    base = unit.removeprefix("k")
    for prefix, factor in (("k", 1.0), ("", 1e3), ("m", 1e6)):
        if largest * factor >= 1:
            return prefix + base, factor
    return "m" + base, 1e6


def _decimals(spread: float, value: float) -> int:
    """Return the number of decimals: two digits of the spread, at most four digits in all; below 1,000 at
    least one."""
    largest = max(abs(value), spread)
    four_digits = 3 - math.floor(math.log10(largest)) if largest else 0
    decimals = min(1 - math.floor(math.log10(spread)), four_digits) if spread > 0 else four_digits
    return min(max(decimals, int(largest < 1e3)), 9)
