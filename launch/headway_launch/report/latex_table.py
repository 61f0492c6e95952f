"""Tables of a report for LaTeX, with the rules of the package booktabs."""

import re
from collections.abc import Sequence
from textwrap import wrap

from headway_launch.report.elements import Table

_ESCAPES = {
    "\\": r"\textbackslash{}",
    **{char: f"\\{char}" for char in "&%$#_{}"},
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "<": r"\textless{}",
    ">": r"\textgreater{}",
    "|": r"\textbar{}",
    "\N{EN DASH}": "--",
    "\N{PLUS-MINUS SIGN}": r"$\pm$",
    "\N{MULTIPLICATION SIGN}": r"$\times$",
    "\N{SUPERSCRIPT TWO}": r"\textsuperscript{2}",
}
_MINUS = re.compile(r"(?<![\w.-])-(?=\d)")
_SMALL = re.compile(r"(?:\$(-)\$|(\+))?(?<![\w.])(\d\.\d+)e-0*(\d+)\b")
"""Numbers as `number_formats.formatted` writes them below 1e-4, with the sign in LaTeX."""
_BREAK = "\0"
_COMMENT_WIDTH = 100
_LONG_TEXT = 40
"""Characters from which on text with spaces is wrapped in its cell."""
_FEWEST_PER_LINE = 12
"""Characters per line of a wrapped heading, at least."""


def latex_table(table: Table, command: str) -> str:
    """Render a table as a `tabular`, below comments with its command and its caption.

    The headings of columns are wrapped to the width of their cells, and a rule separates learners from the
    classical rules.
    """
    columns = list(zip(table.headings, *table.rows, strict=True))
    kinds = [_column(cells, place in table.words) for place, (_, *cells) in enumerate(columns)]
    headings = [
        _heading(heading, max(map(len, cells), default=0), place in table.words)
        for place, (heading, *cells) in enumerate(columns)
    ]
    lines = [
        "% " + " ".join(command.split()),
        *(f"% {line}" for line in wrap(table.caption, _COMMENT_WIDTH, break_on_hyphens=False)),
        r"% It needs \usepackage{booktabs}.",
        rf"\begin{{tabular}}{{{''.join(kinds)}}}",
        r"\toprule",
        _row(headings),
        r"\midrule",
    ]
    for place, cells in enumerate(table.rows):
        if place and (place in table.emphasised) != (place - 1 in table.emphasised):
            lines.append(r"\midrule")
        lines.append(_row([latex(cell) for cell in cells]))
    return "\n".join([*lines, r"\bottomrule", r"\end{tabular}"]) + "\n"


def latex(text: str) -> str:
    """Escape text for LaTeX; the hyphen before a number becomes a minus, and e-05 a power of 10."""
    with_minus = _MINUS.sub("\N{MINUS SIGN}", " ".join(text.split()))
    escaped = "".join(_ESCAPES.get(char, char) for char in with_minus).replace("\N{MINUS SIGN}", "$-$")
    return _SMALL.sub(r"$\1\2\3 \\times 10^{-\4}$", escaped)


def _column(cells: Sequence[str], is_text: bool) -> str:
    if not is_text:
        return "r"
    return r"p{0.5\linewidth}" if any(len(cell) > _LONG_TEXT and " " in cell for cell in cells) else "l"


def _heading(heading: str, width: int, is_text: bool) -> str:
    breakable = heading.replace("_", f"_{_BREAK} ")  # names of rules are long
    lines = wrap(breakable, max(width, _FEWEST_PER_LINE), break_long_words=False, break_on_hyphens=False)
    lines = [line.replace(f"{_BREAK} ", "").removesuffix(_BREAK) for line in lines]
    if len(lines) < 2:
        return latex(heading)
    stacked = r" \\ ".join(map(_after_break, map(latex, lines)))
    return rf"\begin{{tabular}}[b]{{@{{}}{'l' if is_text else 'r'}@{{}}}}{stacked}\end{{tabular}}"


def _row(cells: Sequence[str]) -> str:
    return _after_break(" & ".join(cells)) + r" \\"


def _after_break(line: str) -> str:
    r"""Protect a line that `\\`, which takes a star and brackets as its arguments, would else take."""
    return f"{{}}{line}" if line.startswith(("[", "*")) else line
