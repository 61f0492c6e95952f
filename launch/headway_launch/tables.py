"""Tables on stdout: drawn on a terminal, tab-separated in full precision when piped."""

import sys
from collections.abc import Collection, Sequence

Cell = str | int | float | None


def print_table(
    columns: Sequence[str], rows: Sequence[Sequence[Cell]], title: str = "", whole: Collection[str] = ()
) -> None:
    """Print rows under a line of column names; a None is an empty cell. Columns in `whole` never break.

    When stdout is no terminal: no title, one row a line, cells separated by tabs, numbers unrounded.
    """
    if not sys.stdout.isatty():
        print("\t".join(columns))
        for row in rows:
            print("\t".join("" if cell is None else _one_line(cell) for cell in row))
        return
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    table = Table(title=title or None, title_justify="left")
    for index, column in enumerate(columns):
        numeric = all(isinstance(row[index], int | float | None) for row in rows)
        table.add_column(
            column, justify="right" if numeric else "left", overflow="fold", no_wrap=column in whole
        )
    for row in rows:
        table.add_row(*(Text(shown(cell)) for cell in row))
    Console().print(table)


def shown(cell: Cell) -> str:
    """A cell for reading: four significant digits, thousands separated, `-` for nothing."""
    if cell is None:
        return "-"
    if isinstance(cell, int):
        return f"{cell:,}"
    if isinstance(cell, float):
        return f"{cell:,.0f}" if abs(cell) >= 10_000 else f"{cell:.4g}"
    return cell


def _one_line(cell: Cell) -> str:
    return " ".join(str(cell).split())
