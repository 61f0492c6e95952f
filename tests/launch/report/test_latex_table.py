"""Tables for LaTeX, held to TeX's own rules: what each character means, and what ends a cell and a row."""

import re

import pytest

from headway_launch.console.number_formats import MISSING
from headway_launch.report.elements import Table
from headway_launch.report.latex_table import latex, latex_table

MEANS = {
    r"\textbackslash{}": "\\", r"\&": "&", r"\%": "%", r"\$": "$", r"\#": "#", r"\_": "_", r"\{": "{",
    r"\}": "}", r"\textasciitilde{}": "~", r"\textasciicircum{}": "^", r"\textless{}": "<",
    r"\textgreater{}": ">", r"\textbar{}": "|", r"$\pm$": "±", "$-$": "-", "--": MISSING,
}  # fmt: skip
"""What LaTeX prints for a command, from its manual."""
ACTIVE = set("\\&%$#_{}~^")


def printed(source: str) -> str:
    """Return what LaTeX prints; fails for a special character outside of the commands above."""
    commands = "|".join(re.escape(command) for command in sorted(MEANS, key=len, reverse=True))
    pieces = re.findall(f"({commands})|(.)", source)
    assert not {char for _, char in pieces} & ACTIVE, source
    return "".join(MEANS[command] if command else char for command, char in pieces)


@pytest.mark.parametrize(
    "text", [*MEANS.values(), r"a\b & 5% of $3 #1 x_y {z} ~^<>|", "-1.5 ± 0.2", "e-05 a-b"]
)
def test_latex_prints_the_text(text: str) -> None:
    assert printed(latex(text)) == text


def test_a_minus_is_no_hyphen_and_a_hyphen_no_minus() -> None:
    assert latex("-1.5 [-3, -0.2]") == "$-$1.5 [$-$3, $-$0.2]"
    assert latex("multi-agent, 1e-05, a-1") == "multi-agent, 1e-05, a-1"


def test_small_numbers_have_powers_of_ten() -> None:
    assert latex("-8.396e-05") == r"$-8.396 \times 10^{-5}$"
    assert latex("+1.200e-12 [v1.2e-5]") == r"$+1.200 \times 10^{-12}$ [v1.2e-5]"


def rows(source: str) -> list[list[str]]:
    """Return the cells of the outer tabular's rows."""
    body = source.partition("\\toprule\n")[2].partition("\\bottomrule")[0]
    lines = [line for line in body.splitlines() if line != r"\midrule"]
    assert all(line.endswith(r" \\") for line in lines)
    return [re.split(r" (?<!\\)& ", line.removesuffix(r" \\")) for line in lines]


def test_every_row_has_a_cell_per_column_and_a_rule_sets_the_classical_rules_apart() -> None:
    table = Table(
        "t",
        "Mean ± standard deviation.",
        ["controller", "a & b", "conclusion"],
        [
            ["ippo" * 11, "-1", "x " * 21 + "x"],
            ["rule r_1", "[2]", "100% & more"],
            ["rule r_2", "3", ""],
            ["coma", "4", ""],
        ],
        words=frozenset({0, 2}),
        emphasised=frozenset({1, 2}),
    )
    source = latex_table(table, "headway report bus\n--format latex")
    assert [len(row) for row in rows(source)] == [3] * 5
    assert [[printed(cell) for cell in row] for row in rows(source)][1:] == [list(row) for row in table.rows]
    lines = source.splitlines()
    assert lines[0] == "% headway report bus --format latex"
    assert lines[1] == "% Mean ± standard deviation."
    assert r"\begin{tabular}{lrp{0.5\linewidth}}" in lines
    assert [place for place, line in enumerate(lines) if line == r"\midrule"] == [6, 8, 11]
    assert lines[-1] == r"\end{tabular}"


def test_long_headings_are_stacked_and_no_line_is_taken_for_the_space_after_a_row() -> None:
    r"""LaTeX reads `\\ [95%]` as a row with that much space after it."""
    table = Table("t", "", ["difference from the [95% interval]", "*"], [["[x]", "1"]])
    source = latex_table(table, "")
    assert r"\begin{tabular}[b]{@{}l@{}}difference \\ from the \\ {}[95\% \\ interval]\end{tabular}" in source
    assert not re.search(r"\\\\\s*[\[*]", source)
    assert re.search(r"^\{\}\[x\] & 1", source, re.MULTILINE)
