"""The files of a report, by format."""

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from markdown_it import MarkdownIt

from headway_launch.commands.main import run as run_command
from headway_launch.report.elements import Report
from headway_launch.report.report_files import FORMATS, write_report
from headway_launch.report.study_data import StudyData
from headway_launch.report.study_report import report_of

Keep = Callable[..., Path]
RULES = {"random": -20.0, "optimal": 10.0}


@pytest.fixture(scope="module")
def root(keep_run_in: Callable[[Path], Keep], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A store with a study of two algorithms with three seeds each; the tests leave it as it is."""
    store = tmp_path_factory.mktemp("files") / "store"
    keep_run = keep_run_in(store)
    for seed in range(3):
        for algorithm in ("ippo", "ia2c"):
            keep_run(("experiment=toy_tracking", f"algo={algorithm}"), seed, 5.0 + seed, rules=RULES)
    return store


@pytest.fixture(scope="module")
def report(root: Path) -> Report:
    return report_of(StudyData(root, "study"), "headway report study")


@pytest.fixture(scope="module")
def formats(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("formats")


@pytest.fixture(scope="module")
def pages(report: Report, formats: Path) -> dict[str, Path]:
    """The report in every format: its page, or its folder."""
    return {name: write_report(report, formats / name, FORMATS[name]) for name in FORMATS}


def files_in(folder: Path) -> set[str]:
    return {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}


def test_a_markdown_page_links_every_file_beside_it_and_no_other(root: Path, tmp_path: Path) -> None:
    folder = tmp_path / "page"
    words = ["study", "--store", str(root), f"--output={folder}", "--format", "markdown"]
    assert run_command(["report", *words]) == 0
    text = (folder / "report.md").read_text()
    children = [
        child
        for token in MarkdownIt("commonmark").enable("table").parse(text)
        for child in token.children or ()
    ]
    linked = [child.attrs.get("href") or child.attrs.get("src") for child in children if child.attrs]
    assert files_in(folder) == {"report.md", *linked}
    assert len(linked) == len(set(linked)) > 6
    assert all(path.read_bytes().startswith(b"<?xml") for path in (folder / "pictures").iterdir())
    assert not [name for name in files_in(folder) if str(tmp_path) in (folder / name).read_text()]
    command = "headway report study --store FOLDER/store --output=FOLDER/page --format markdown"
    assert f"Written by `{command}` from the store's files alone" in " ".join(text.split())


def test_formats_share_sections_and_tables(report: Report, pages: dict[str, Path], formats: Path) -> None:
    html, text = pages["html"].read_text(), pages["markdown"].read_text()
    titles = [section.title for section in report.sections]
    assert titles == re.findall("^## (.*)$", text, re.MULTILINE) == re.findall("<h2>(.*)</h2>", html)[1:]
    tables = {name: {Path(file).stem for file in files_in(formats / name / "tables")} for name in FORMATS}
    assert tables["html"] == tables["latex"] == tables["csv"] > {"setup", "final_rewards", "versions"}
    assert tables["markdown"] == {"runs"}
    for name in tables["csv"]:
        exact = (formats / "csv" / "tables" / f"{name}.csv").read_text()
        assert exact == (formats / "html" / "tables" / f"{name}.csv").read_text()
    assert {Path(name).suffix for name in files_in(formats / "latex" / "pictures")} == {".pdf"}
    assert pages["csv"] == formats / "csv"
    assert files_in(formats / "csv") == {f"tables/{name}.csv" for name in tables["csv"]}


def test_one_table_is_printed_as_it_is_in_the_files(
    root: Path, pages: dict[str, Path], formats: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    asked = ["report", "study", "--store", str(root), "--table", "final_rewards", "--format"]
    for form, file in (("csv", "csv/tables/final_rewards.csv"), ("latex", "latex/tables/final_rewards.tex")):
        assert run_command([*asked, form]) == 0
        lines = capsys.readouterr().out.splitlines()
        without_command = [line for line in lines if not line.startswith("% headway")]
        known = (formats / file).read_text().splitlines()
        assert without_command == [line for line in known if not line.startswith("% headway")]
    assert run_command([*asked, "markdown"]) == 0
    caption, table = capsys.readouterr().out.split("\n\n")
    assert table in pages["markdown"].read_text()
    line = "headway report study --store FOLDER/store --table final_rewards --format markdown"
    assert " ".join(caption.split()).endswith(f"Written by `{line}`.")


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (
            ["--table", "final_reward", "--format", "csv"],
            "unknown table 'final_reward'; did you mean final_rewards?",
        ),
        (["--table", "energy"], "--table prints a table as --format markdown, latex or csv; add one of them"),
        (["--table", "energy", "--format", "csv", "--output", "x"], "--output has no effect with --table"),
    ],
)
def test_a_table_that_cannot_be_printed_is_one_line(
    words: list[str], line: str, root: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run_command(["report", "study", "--store", str(root), *words]) == 2
    assert line in capsys.readouterr().err


def test_the_same_store_gives_the_same_files(root: Path, pages: dict[str, Path], tmp_path: Path) -> None:
    again = report_of(StudyData(root, "study"), "headway report study")
    for name, page in pages.items():
        folder = page.parent if FORMATS[name].page else page
        write_report(again, tmp_path / name, FORMATS[name])
        assert files_in(tmp_path / name) == files_in(folder)
        for file in files_in(folder):
            assert (tmp_path / name / file).read_bytes() == (folder / file).read_bytes(), file


def test_files_of_an_earlier_report_are_listed(
    report: Report, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    runs = [section for section in report.sections if section.title == "Runs"]
    report = replace(report, sections=runs)
    for chosen in FORMATS.values():
        write_report(report, tmp_path / "report", chosen)
    assert capsys.readouterr().err == ""
    (tmp_path / "report" / "tables" / "scaling.csv").write_text("of before")
    write_report(report, tmp_path / "report", FORMATS["html"])
    told = f"kept in {tmp_path / 'report'}, but not of this report: tables/scaling.csv\n"
    assert capsys.readouterr().err == told
