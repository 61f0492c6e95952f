"""Pictures as commands write them."""

import re
import zlib
from pathlib import Path

import pytest
from matplotlib.figure import Figure

from headway.contracts.errors import HeadwayError
from headway_launch.console.output_files import write_figure


def _figure() -> Figure:
    figure = Figure()
    figure.subplots().set_title("Reward ± deviation, m/s²")
    return figure


def test_pdf_embeds_its_fonts_as_truetype(tmp_path: Path) -> None:
    """Type 42 is TrueType. Publishers refuse Type 3, matplotlib's default."""
    write_figure(_figure(), tmp_path / "a.pdf")
    content = (tmp_path / "a.pdf").read_bytes()
    assert b"/CIDFontType2" in content
    assert b"/Type3" not in content
    assert b"/CreationDate" not in content
    [font] = [
        program
        for length, program in re.findall(rb"/Length1 (\d+).*?stream\r?\n(.*?)endstream", content, re.DOTALL)
    ]
    assert zlib.decompress(font)[:4] in (b"\0\1\0\0", b"true")


@pytest.mark.parametrize("suffix", ["svg", "pdf", "png"])
def test_equal_figures_give_equal_files(suffix: str, tmp_path: Path) -> None:
    for name in "ab":
        write_figure(_figure(), tmp_path / f"{name}.{suffix}")
    assert (tmp_path / f"a.{suffix}").read_bytes() == (tmp_path / f"b.{suffix}").read_bytes()


@pytest.mark.parametrize(("name", "line"), [("a", "has no suffix"), ("a.pgn", "'pgn' is not supported")])
def test_a_suffix_without_a_format_is_refused(name: str, line: str, tmp_path: Path) -> None:
    with pytest.raises(HeadwayError, match=line):
        write_figure(_figure(), tmp_path / name)
