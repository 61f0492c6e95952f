"""What a report is made of: sections of paragraphs, tables, pictures, listings. How figures are written."""

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
    """A table as it is read, and the same figures whole."""

    name: str
    """Of its files."""
    caption: str
    headings: Sequence[str]
    rows: Sequence[Sequence[str]]
    """Text as it is read; the first column names the row."""
    data: "pd.DataFrame"
    """All digits, for the CSV."""
    words: frozenset[int] = frozenset({0})
    """Columns that are text; the others are figures."""
    emphasised: frozenset[int] = frozenset()
    """Rows that are no learner's: the classical rules."""


@dataclass(frozen=True)
class Picture:
    """A picture with what it shows."""

    name: str
    """Of its file."""
    caption: str
    figure: "Figure"


@dataclass(frozen=True)
class Listing:
    """Text that is long or exact, under its title; the reader may fold it."""

    title: str
    text: str
    file: str = ""
    """Where it is kept as a file of its own, if it is."""
    unfolded: bool = False


Part = str | Table | Picture | Listing
"""A string is a paragraph, in which `this` is code."""


@dataclass(frozen=True)
class Section:
    """A part of the page with a heading."""

    anchor: str
    title: str
    body: list[Part] = field(default_factory=list)


def figure(value: float | None, digits: int = _DIGITS) -> str:
    """Four significant digits, thousands separated; a dash for what is not known."""
    if value is None or not math.isfinite(value):
        return MISSING
    if value == int(value) and abs(value) < 1e15:
        return f"{int(value):,}"
    if abs(value) < 1e-4:
        return f"{value:.{digits - 1}e}"
    return f"{value:,.{max(digits - 1 - math.floor(math.log10(abs(value))), 0)}f}"


def with_deviation(mean: float, deviation: float, decimals: int | None = None) -> str:
    """`71.28 ± 0.15`, as the papers write it; without the deviation where that is not known."""
    if not math.isfinite(mean):
        return MISSING
    if decimals is None:
        decimals = _decimals(deviation if math.isfinite(deviation) else 0.0, mean)
    if not math.isfinite(deviation):
        return f"{mean:,.{decimals}f}"
    return f"{mean:,.{decimals}f} ± {deviation:,.{decimals}f}"


def with_interval(estimate: float, low: float, high: float, sign: bool = False) -> str:
    """`20.5 [15.4, 25.7]`; without the interval where that is not known. `sign` writes a plus."""
    if not math.isfinite(estimate):
        return MISSING
    plus = "+" if sign else ""
    if not (math.isfinite(low) and math.isfinite(high)):
        return f"{estimate:{plus},.{_decimals(0.0, estimate)}f}"
    decimals = _decimals(high - low, estimate)
    return f"{estimate:{plus},.{decimals}f} [{low:,.{decimals}f}, {high:,.{decimals}f}]"


def scale_of(largest: float, unit: str) -> tuple[str, float]:
    """The unit in which a figure up to `largest` reads well, and the factor to it: (`mWh`, 1e6) for 3e-5 kWh.
    `unit` begins with k."""
    base = unit.removeprefix("k")
    for prefix, factor in (("k", 1.0), ("", 1e3), ("m", 1e6)):
        if largest * factor >= 1:
            return prefix + base, factor
    return "m" + base, 1e6


def _decimals(spread: float, value: float) -> int:
    """Two digits of the spread, at most four of the whole, and one decimal for values below 1,000."""
    largest = max(abs(value), spread)
    four_digits = 3 - math.floor(math.log10(largest)) if largest else 0
    decimals = min(1 - math.floor(math.log10(spread)), four_digits) if spread > 0 else four_digits
    return min(max(decimals, int(largest < 1e3)), 9)
