"""The Markdown of a report, held to what a CommonMark parser with GitHub's tables reads from it."""

import re

import pandas as pd
import pytest
from markdown_it import MarkdownIt
from markdown_it.token import Token
from matplotlib.figure import Figure

from headway_launch.report.elements import Listing, Part, Picture, Report, Section, Table
from headway_launch.report.markdown_page import markdown, markdown_table

HOSTILE = "a|b \\ *c* **d** _e_ `` __f__ <b>g</b> <!-- h --> &lt; &#65; [i](j) [k]: l [^m] ~~n~~ $o$ {p} <https://q.r>"
PLAIN = "20.5 [15.4, 25.7] & rule headway_holding_0.9, -3 < 4 > 2: 95% of 1,000 ± 3; {a: 1} (b) # 1. - c + d"


def parsed(text: str) -> list[Token]:
    return MarkdownIt("commonmark").enable(["table", "strikethrough"]).parse(text)


def read(tokens: list[Token]) -> list[str]:
    """Return the text of each block that holds text; code is between backquotes."""
    shown = {"text": "{}", "text_special": "{}", "softbreak": " ", "code_inline": "`{}`"}
    return [
        "".join(shown[child.type].format(child.content) for child in block.children or ())
        for block in tokens
        if block.type == "inline"
    ]


def page(*parts: Part, title: str = "Title", summary: tuple[str, ...] = ()) -> str:
    section = Section("anchor", "Section", list(parts))
    return markdown(Report(title, "Subtitle", summary, [section], "headway report", "Footer"))


@pytest.mark.parametrize("text", [HOSTILE.replace("`", "'"), PLAIN])
def test_text_is_read_as_it_was(text: str) -> None:
    table = Table("t", text, [text, text], [[text, text]], pd.DataFrame())
    assert read(parsed(markdown_table(table))) == [text] * 5
    shown = page(text, title=text, summary=(text, text))
    assert read(parsed(shown)) == [text, "Subtitle", text, text, "Section", text, "Footer"]


@pytest.mark.parametrize(
    "word",
    [
        "#", "##", ">", "-", "+", "*", ":", "1.", "1)", "12.", "%", "---", "===", "+++", "=", "|", "[a]: b",
        "-3", "0.9",
    ],
)  # fmt: skip
@pytest.mark.parametrize("after", [" then", ""])
def test_no_line_of_a_paragraph_begins_another_block(word: str, after: str) -> None:
    """The word begins the paragraph, or for some length of what is before it a line, or a line of its own."""
    for before in (0, *range(100, 112)):
        text = " ".join(["x" * before, word + after, *["y" * 104] * (not after)]).strip()
        shown = page(text, summary=(text,))
        assert read(parsed(shown)) == ["Title", "Subtitle", text, "Section", text, "Footer"]
        kinds = [token.type for token in parsed(page(text)) if token.type.endswith("_open")]
        assert kinds == ["heading_open", "paragraph_open"] * 2 + ["paragraph_open"]


def test_syntax_of_myst_is_escaped() -> None:
    """Roles, comments and definitions, which CommonMark does not have."""
    assert "\\{a}`b`" in page("{a}`b`")
    assert "\n\\% a" in page("% a")
    assert "\n\\: a" in page(": a")


def test_lines_are_short_and_code_stays_whole() -> None:
    code = "headway run env=bus algo=ippo 'a - b' seed=0..9"
    shown = page(" ".join([f"word `{code}`"] * 9))
    assert read(parsed(shown))[3] == " ".join([f"word `{code}`"] * 9)
    assert max(map(len, shown.splitlines())) <= 110
    assert shown.count(f"`{code}`") == 9


def test_a_table_has_a_cell_per_heading_and_aligns_numbers() -> None:
    table = Table("t", "Caption.", ["name", "n|m"], [["a|b", "1"], ["c\nd", "2"]], pd.DataFrame())
    tokens = parsed(page(table))
    kinds = [token.type for token in tokens]
    assert (kinds.count("th_open"), kinds.count("td_open"), kinds.count("tr_open")) == (2, 4, 3)
    numbers = [token for token in tokens if token.type == "td_open"][1::2]
    assert {token.attrs["style"] for token in numbers} == {"text-align:right"}
    assert "**Table 1.** Caption." in page(table)


def test_pictures_and_long_parts_are_links_within_the_folder() -> None:
    parts = [
        Picture("a_curve", "Shown.", Figure()),
        Table("runs", "Every run.", ["run"], [["r1"]], pd.DataFrame(), per_run=True),
        Listing("Settings", "key: 1", "configs/a.yaml"),
        Listing("Commands", "headway ```run```", unfolded=True),
        Picture("b", "Shown too.", Figure()),
    ]
    shown = page(*parts)
    linked = re.findall(r"\]\((.*?)\)", shown)
    assert linked == ["pictures/a_curve.svg", "tables/runs.csv", "configs/a.yaml", "pictures/b.svg"]
    assert "r1" not in shown
    assert "**Figure 2.** Shown too." in shown
    [block] = [token for token in parsed(shown) if token.type == "fence"]
    assert block.content == "headway ```run```\n"
