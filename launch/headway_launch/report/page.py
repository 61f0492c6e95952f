"""Report files: one self-contained HTML page, and its parts as separate files."""

import base64
import io
from collections.abc import Sequence
from dataclasses import dataclass, replace
from importlib.resources import files
from pathlib import Path

from headway_launch.console.output import print_line
from headway_launch.console.output_files import write_error
from headway_launch.report.elements import Listing, Part, Picture, Section, Table

PAGE = "report.html"
_PARTS = ("tables", "pictures", "configs")
_FILES = "Beside this page are its tables as Markdown and CSV (with all digits) and its pictures as PNG."


@dataclass(frozen=True)
class Report:
    """Contents of the page."""

    title: str
    subtitle: str
    summary: Sequence[str]
    """Sentences of the summary box at the top."""
    sections: Sequence[Section]
    footer: str


def write_report(report: Report, folder: Path) -> Path:
    """Write the page and its parts into `folder`, created if needed; return the path of the page.

    Files of an earlier report that this one does not write are kept and listed. Raises HeadwayError if the
    folder cannot be written.
    """
    try:
        for name in _PARTS:
            (folder / name).mkdir(parents=True, exist_ok=True)
        written = {
            path for section in report.sections for part in section.body for path in _write_part(part, folder)
        }
        page = folder / PAGE
        page.write_text(html(replace(report, footer=f"{report.footer} {_FILES}")), encoding="utf-8")
    except OSError as error:
        raise write_error("--output", folder, error) from error
    others = sorted(
        str(path.relative_to(folder))
        for name in _PARTS
        for path in (folder / name).iterdir()
        if path not in written
    )
    if others:
        print_line(f"files of an earlier report kept in {folder}: {', '.join(others)}")
    return page


def html(report: Report) -> str:
    """Render the page; all names and texts are escaped."""
    from jinja2 import Environment

    source = files("headway_launch.report").joinpath("page.html").read_text(encoding="utf-8")
    environment = Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True)
    environment.filters["code"] = _with_code
    environment.filters["breakable"] = _breakable
    environment.tests["table"] = lambda part: isinstance(part, Table)
    environment.tests["picture"] = lambda part: isinstance(part, Picture)
    environment.tests["listing"] = lambda part: isinstance(part, Listing)
    return environment.from_string(source).render(report=report, picture_data=_inline)


def markdown(table: Table) -> str:
    """Format a table as Markdown, below its caption."""

    def row(cells: Sequence[str]) -> str:
        return "| " + " | ".join(cell.replace("|", "\\|").replace("\n", " ") for cell in cells) + " |"

    ruler = ["---" if place in table.words else "---:" for place in range(len(table.headings))]
    lines = [table.caption, "", row(table.headings), row(ruler), *map(row, table.rows)]
    return "\n".join(lines) + "\n"


def _write_part(part: Part, folder: Path) -> list[Path]:
    """Write a part to its files; return their paths."""
    match part:
        case Table(name=name, data=data):
            table, csv = (folder / "tables" / f"{name}.{kind}" for kind in ("md", "csv"))
            table.write_text(markdown(part), encoding="utf-8")
            data.to_csv(csv, index=False)
            return [table, csv]
        case Picture(name=name, figure=figure):
            picture = folder / "pictures" / f"{name}.png"
            figure.savefig(picture, dpi=200)
            return [picture]
        case Listing(text=text, file=file) if file:
            listing = folder / file
            listing.write_text(text if text.endswith("\n") else text + "\n", encoding="utf-8")
            return [listing]
        case _:
            return []


def _inline(picture: Picture) -> str:
    """Return a picture as a data URL of an SVG."""
    import matplotlib as mpl

    content = io.BytesIO()
    # Without date and random salt, the same data gives the same page byte for byte.
    with mpl.rc_context({"svg.hashsalt": picture.name}):
        picture.figure.savefig(content, format="svg", metadata={"Date": None})
    return "data:image/svg+xml;base64," + base64.b64encode(content.getvalue()).decode()


def _breakable(heading: str) -> object:
    """Let a heading break after underscores, because names of rules are long."""
    from markupsafe import Markup

    return Markup("_<wbr>").join(heading.split("_"))


def _with_code(text: str) -> object:
    """Set text between backquotes as code."""
    from markupsafe import Markup, escape

    pieces = [
        Markup("<code>{}</code>").format(piece) if place % 2 else escape(piece)
        for place, piece in enumerate(text.split("`"))
    ]
    return Markup("").join(pieces)
