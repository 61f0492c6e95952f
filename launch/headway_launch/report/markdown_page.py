"""A report as one page of Markdown, for GitHub and for Sphinx with MyST; pictures are links."""

import re
from itertools import count
from textwrap import indent, wrap

from headway_launch.report.elements import Listing, Part, Picture, Report, Section, Table, text_and_code

PICTURES = "svg"
"""Suffix of the pictures that the page shows."""
_WIDTH = 110
_SPACE_IN_CODE = "\0"
_SPECIAL = re.compile(
    r"[\\*~$|{]"
    r"|<(?=[A-Za-z/!?])"  # a tag
    r"|&(?=#?\w+;)"
    r"|(?<![^\W_])_|_(?![^\W_])"  # within a word an underscore is no emphasis
    r"|\[(?=\^|[^\]]*\][(\[])"  # a link or a footnote
)
_BLOCK_START = re.compile(r"^(?=[#>%]|[-+*:](?:\s|$)|(?:[-=+]+)$|\[[^\]]*\]:)")
_NUMBERED = re.compile(r"^(\d+)(?=[.)](?:\s|$))")


def markdown(report: Report) -> str:
    """Render the page; text is escaped and wrapped. Paths of files are relative to the report's folder."""
    tables, pictures = count(1), count(1)

    def rendered(part: Part) -> str:
        match part:
            case Table():
                label = f"**Table {next(tables)}.** "
                if part.per_run:
                    return f"{_paragraph(part.caption, label)}\n[All rows as CSV]({part.file('csv')})."
                return markdown_table(part, label)
            case Picture():
                alt = _escaped(part.name.replace("_", " ").capitalize())
                caption = _paragraph(part.caption, f"**Figure {next(pictures)}.** ")
                return f"![{alt}]({part.file(PICTURES)})\n\n{caption}"
            case Listing():
                return _listing(part)
            case _:
                return _paragraph(part)

    def section_blocks(section: Section) -> list[str]:
        return [f"## {_escaped(section.title)}", *map(rendered, section.body)]

    bullets = "\n".join("- " + indent(_paragraph(sentence), "  ").lstrip() for sentence in report.summary)
    blocks = [f"# {_escaped(report.title)}", _paragraph(report.subtitle), bullets]
    blocks += [block for section in report.sections for block in section_blocks(section)]
    return "\n\n".join([*filter(None, blocks), _paragraph(report.footer)]) + "\n"


def markdown_table(table: Table, label: str = "") -> str:
    """Render a table as a pipe table below its caption; `label` is Markdown before the caption."""
    ruler = ["---" if place in table.words else "---:" for place in range(len(table.headings))]
    escaped = [[_escaped(" ".join(cell.split())) for cell in row] for row in (table.headings, *table.rows)]
    lines = (f"| {' | '.join(row)} |" for row in (escaped[0], ruler, *escaped[1:]))
    return "\n".join([_paragraph(table.caption, label), "", *lines])


def _listing(listing: Listing) -> str:
    if listing.file and not listing.unfolded:
        return f"[{_escaped(listing.title)}]({listing.file})"
    longest = max((len(ticks) for ticks in re.findall("`+", listing.text)), default=0)
    fence = "`" * max(3, longest + 1)
    return f"{_paragraph(listing.title)}\n\n{fence}\n{listing.text.rstrip()}\n{fence}"


def _paragraph(text: str, label: str = "") -> str:
    """Escape and wrap text after a label, which is Markdown. Lines do not break within code."""
    pieces = [
        f"`{piece.replace(' ', _SPACE_IN_CODE)}`" if is_code else _escaped(piece)
        for piece, is_code in text_and_code(text)
    ]
    lines = wrap(label + "".join(pieces), _WIDTH, break_long_words=False, break_on_hyphens=False)
    return "\n".join(map(_inline_only, lines)).replace(_SPACE_IN_CODE, " ")


def _escaped(text: str) -> str:
    return _SPECIAL.sub(lambda found: "\\" + found.group(), text)


def _inline_only(line: str) -> str:
    """Return the line with an escape if it would begin a heading, a list, a comment or another block."""
    return _NUMBERED.sub(r"\1\\", _BLOCK_START.sub(r"\\", line))
