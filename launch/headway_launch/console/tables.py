"""Tables on stdout: fitted to the width of a terminal, tab-separated when piped."""

import re
import sys
from collections.abc import Callable, Collection, Sequence
from typing import TYPE_CHECKING, Literal

from headway_launch.console.number_formats import MISSING
from headway_launch.console.output import print_line

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

Value = str | int | float | None

_PADDING = 3
"""Characters per column in addition to its contents: two spaces and a line."""
_UNBROKEN_TEXT, _UNBROKEN_HEADING = 12, 8
"""Length up to which words of text, and of the headings of numbers, are never broken on a narrow terminal."""


def omission(omitted: Sequence[str]) -> str:
    """Return the note on the columns that a narrow terminal has no room for; empty if there are none."""
    return f"columns omitted on this narrow terminal: {', '.join(omitted)}" if omitted else ""


def print_table(
    columns: Sequence[str],
    rows: Sequence[Sequence[Value]],
    title: str = "",
    whole: Collection[str] = (),
    spare: Sequence[str] = (),
    numbers: Collection[str] = (),
    note: Callable[[Sequence[str]], str] = omission,
) -> None:
    """Print rows under a line of column names; None is an empty value.

    On a terminal too narrow for the table, columns in `spare` are omitted in that order; if that is not
    enough, columns in `whole` are wrapped too; if that is not enough either, each row is printed as a list of
    its values. Numbers, and the columns `numbers` of formatted ones, are never wrapped. If stdout is not a
    terminal: no title, one row per line, cells separated by tabs, numbers with the same digits, without
    separators of thousands, missing ones empty. `note` returns the line below the table for the omitted
    columns, or an empty string; it goes to stderr if stdout is not a terminal.
    """
    if not sys.stdout.isatty():
        print("\t".join(columns))
        for row in rows:
            cells = zip(columns, row, strict=True)
            print("\t".join(_piped(_plain(cell) if name in numbers else cell) for name, cell in cells))
        if line := note(()):
            sys.stdout.flush()
            print_line(line)
        return
    from rich.console import Console

    console = Console()
    layout = _Layout(columns, rows, whole, numbers)
    left_out = layout.leave_out(spare, console.width)
    if layout.least_width > console.width:
        for column in layout.columns:
            column.firm = column.numeric
    if layout.least_width > console.width:
        _print_as_lists(console, _Layout(columns, rows, whole, numbers), title)
        left_out = []
    else:
        console.print(layout.fitted(console.width, title))
    if line := note(left_out):
        console.print(line, highlight=False, markup=False, soft_wrap=True)


def without_empty(
    columns: Sequence[str], rows: Sequence[Sequence[Value]], names: Collection[str]
) -> tuple[list[str], list[list[Value]]]:
    """Drop the named columns whose cells are all empty."""
    kept = [
        index
        for index, name in enumerate(columns)
        if name not in names or any(row[index] is not None for row in rows)
    ]
    return [columns[index] for index in kept], [[row[index] for index in kept] for row in rows]


def shown(value: Value, thousands: str = ",", empty: str = "-") -> str:
    """Format a value of a table: four significant digits, whole parts in full.

    `thousands`: their separator, `,` or none; `empty`: the text of None.
    """
    if value is None:
        return empty
    if isinstance(value, int):
        return f"{value:{thousands}}"
    if isinstance(value, float):
        return f"{value:{thousands}.0f}" if abs(value) >= 9_999.5 else f"{value:.4g}"
    return value


class _Layout:
    """Formatted columns of a table, and the width they need."""

    def __init__(
        self,
        columns: Sequence[str],
        rows: Sequence[Sequence[Value]],
        whole: Collection[str],
        numbers: Collection[str],
    ) -> None:
        self.columns = [
            _Column(name, [row[index] for row in rows], name in whole, name in numbers)
            for index, name in enumerate(columns)
        ]

    def leave_out(self, spare: Sequence[str], width: int) -> list[str]:
        """Omit spare columns until the others fit; return the omitted ones."""
        left_out: list[str] = []
        for name in spare:
            if self.least_width <= width:
                break
            self.columns = [column for column in self.columns if column.name != name]
            left_out.append(name)
        return left_out

    @property
    def least_width(self) -> int:
        """Width of the table with headings and text wrapped as far as allowed."""
        return 1 + sum(_PADDING + column.least for column in self.columns)

    def fitted(self, width: int, title: str) -> "Table":
        """Return the table, at most `width` wide; the widest columns are narrowed first."""
        from rich.table import Table
        from rich.text import Text

        widths = [column.longest for column in self.columns]
        for _ in range(1 + sum(_PADDING + own for own in widths) - width):
            giving = [index for index, column in enumerate(self.columns) if widths[index] > column.least]
            widths[max(giving, key=lambda index: widths[index])] -= 1
        table = Table(title=title or None, title_justify="left")
        for column, own in zip(self.columns, widths, strict=True):
            justify: Literal["left", "right"] = "right" if column.numeric else "left"
            table.add_column(Text(column.name), justify=justify, overflow="fold", width=own)
        for values in zip(*(column.texts for column in self.columns), strict=True):
            table.add_row(*(Text(value) for value in values))
        return table


class _Column:
    def __init__(self, name: str, values: Sequence[Value], whole: bool, numeric: bool) -> None:
        self.name = name
        self.texts = [shown(value) for value in values]
        self.numeric = numeric or all(isinstance(value, int | float | None) for value in values)
        self.firm = self.numeric or whole
        """Its text does not wrap."""

    @property
    def longest(self) -> int:
        """Width without wrapping."""
        return max([1, len(self.name), *map(len, self.texts)])

    @property
    def least(self) -> int:
        """Width with all allowed wrapping."""
        heading = max([1, *map(len, self.name.split())])
        if self.firm:
            return max([min(heading, _UNBROKEN_HEADING), *map(len, self.texts)])
        words = (len(word) for text in self.texts for word in text.split())
        return min(max([heading, *words]), _UNBROKEN_TEXT)


def _print_as_lists(console: "Console", layout: _Layout, title: str) -> None:
    lines = [title] if title else []
    name_width = max(len(column.name) for column in layout.columns)
    for values in zip(*(column.texts for column in layout.columns), strict=True):
        for column, value in zip(layout.columns, values, strict=True):
            lines.append(f"{column.name:<{name_width}}  {value}")
        lines.append("")
    console.print("\n".join(lines), highlight=False, markup=False, soft_wrap=True)


def _plain(value: Value) -> Value:
    """Return a formatted number without separators of thousands, and None for a missing one."""
    if not isinstance(value, str):
        return value
    return None if value == MISSING else re.sub(r"(?<=\d),(?=\d{3})", "", value)


def _piped(value: Value) -> str:
    return " ".join(shown(value, thousands="", empty="").split())
