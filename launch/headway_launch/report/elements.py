"""A report and its parts: sections of paragraphs, tables, pictures and listings.

The modules `html_page`, `markdown_page` and `latex_table` render them.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure


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
