"""The files of a report, by format: a page, its tables and pictures, or what a paper needs."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from headway.config.schema import suggestion
from headway.contracts.errors import HeadwayError
from headway_launch.console.output import print_line
from headway_launch.console.output_files import save_figure, write_error
from headway_launch.report.elements import Listing, Part, Picture, Report, Table
from headway_launch.report.html_page import html
from headway_launch.report.latex_table import latex_table
from headway_launch.report.markdown_page import PICTURES, markdown, markdown_table

_PARTS = ("tables", "pictures", "configs")
_DOTS_PER_INCH = 200
_BESIDE = " Beside this page are its tables as CSV (with all digits) and its pictures as PNG."


@dataclass(frozen=True)
class Page:
    """The page of a report."""

    name: str
    render: Callable[[Report], str]
    note: str = ""
    """End of its footer."""


@dataclass(frozen=True)
class ReportFormat:
    """What a report is written as."""

    page: Page | None = None
    """Without a page there are no listings."""
    tables: str = ""
    """Suffix of the tables' files; empty: there are none."""
    pictures: str = ""


FORMATS: Mapping[str, ReportFormat] = {
    "html": ReportFormat(Page("report.html", html, _BESIDE), "csv", "png"),
    "markdown": ReportFormat(Page("report.md", markdown), pictures=PICTURES),
    "latex": ReportFormat(tables="tex", pictures="pdf"),
    "csv": ReportFormat(tables="csv"),
}
"""Formats by the value of --format."""


def table_text(report: Report, name: str, form: str) -> str:
    """Return a table of a report as `markdown`, `latex` or `csv`.

    Raises HeadwayError if the report has no such table.
    """
    parts = [part for section in report.sections for part in section.body]
    tables = {part.name: part for part in parts if isinstance(part, Table)}
    if name not in tables:
        raise HeadwayError(f"--table: unknown table {name!r}; {suggestion(name, tables)}")
    table = tables[name]
    if form == "markdown":
        caption = f"{report.title}. {table.caption} Written by `{report.command}`."
        return markdown_table(replace(table, caption=caption)) + "\n"
    return _in_format(table, FORMATS[form].tables, report.command)


def write_report(report: Report, folder: Path, chosen: ReportFormat) -> Path:
    """Write the page and its parts into `folder`, created if needed; return the path of the page, or the
    folder if there is none.

    Files of an earlier report that this one has in no format are kept and listed. Raises HeadwayError if the
    folder cannot be written.
    """
    parts = [part for section in report.sections for part in section.body]
    path = folder
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for part in parts:
            if name := _file_of(part, chosen):
                _write_part(part, report.command, folder / name)
        if page := chosen.page:
            path = folder / page.name
            text = page.render(replace(report, footer=report.footer + page.note))
            path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise write_error("--output", folder, error) from error
    known = {_file_of(part, each) for part in parts for each in FORMATS.values()}
    present = {str(each.relative_to(folder)) for name in _PARTS for each in (folder / name).glob("*")}
    if others := sorted(present - known):
        print_line(f"kept in {folder}, but not of this report: {', '.join(others)}")
    return path


def _file_of(part: Part, chosen: ReportFormat) -> str:
    """Return the path of a part's file in the report's folder, or an empty string if it gets none."""
    match part:
        case Table(per_run=True) if chosen.page:
            return part.file("csv")
        case Table() if chosen.tables:
            return part.file(chosen.tables)
        case Picture() if chosen.pictures:
            return part.file(chosen.pictures)
        case Listing(file=file) if chosen.page:
            return file
        case _:
            return ""


def _write_part(part: Part, command: str, path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    match part:
        case Table():
            path.write_text(_in_format(part, path.suffix[1:], command), encoding="utf-8")
        case Picture(figure=figure):
            save_figure(figure, path, path.suffix[1:], _DOTS_PER_INCH)
        case Listing(text=text):
            path.write_text(text if text.endswith("\n") else text + "\n", encoding="utf-8")


def _in_format(table: Table, suffix: str, command: str) -> str:
    return str(table.exact.to_csv(index=False)) if suffix == "csv" else latex_table(table, command)
