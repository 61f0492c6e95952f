"""`headway search` finds a winner by real runs, and `headway plot` draws them."""

import io
import subprocess
import sys
from contextlib import redirect_stdout
from dataclasses import dataclass
from pathlib import Path

import pytest
from command_lines import Refused, RowsOf

from headway.contracts.errors import HeadwayError
from headway.store.index import RunIndex
from headway_launch.commands.main import run
from headway_launch.experiments.options import own_configs
from headway_launch.experiments.search import read_search
from headway_launch.runner.runner import Runner

SMALL = ("toy_matrix", "env_steps=2048", "backend=serial", "energy=off")


@dataclass(frozen=True)
class Searched:
    """A store with the runs of a search, and the table of its winners."""

    root: Path
    winners: str


def winners_of(told: str) -> str:
    return told[told.index("cell\tcandidate") :]


@pytest.fixture(scope="module")
def searched(tmp_path_factory: pytest.TempPathFactory) -> Searched:
    root = tmp_path_factory.mktemp("store")
    with redirect_stdout(io.StringIO()) as told:
        assert run(["search", *SMALL, f"store.root={root}"]) == 0
    return Searched(root, winners_of(told.getvalue()))


@pytest.mark.slow
def test_a_search_names_one_winner_a_cell(searched: Searched) -> None:
    rows = [line.split("\t") for line in searched.winners.splitlines()[1:] if line]
    assert [row[1] for row in rows] == ["lr 5e-4", "lr 5e-3"]
    first, second = (float(row[2]) for row in rows)
    words = ["best", ""] if first > second else ["", "best"]
    assert [row[3] for row in rows] == (["tied best"] * 2 if first == second else words)


@pytest.mark.slow
def test_a_search_given_again_trains_nothing_and_names_the_same_winner(
    searched: Searched, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["search", *SMALL, f"store.root={searched.root}"]) == 0
    again = capsys.readouterr()
    assert "2 finished and skipped" in again.err
    assert winners_of(again.out) == searched.winners
    assert len(RunIndex(searched.root).rows("search_toy_matrix")) == 2


@pytest.mark.slow
def test_a_study_is_drawn(searched: Searched, tmp_path: Path) -> None:
    picture = tmp_path / "curves.png"
    where = ("--store", str(searched.root), "--output", str(picture))
    assert run(["plot", "search_toy_matrix", *where]) == 0
    assert picture.read_bytes().startswith(b"\x89PNG")


@pytest.mark.slow
def test_cells_and_rules_are_compared_on_the_same_days(
    searched: Searched, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["compare", "search_toy_matrix", "--store", str(searched.root), "--episodes", "4"]) == 0
    shown = capsys.readouterr()
    header, *rows = [line.split("\t") for line in shown.out.splitlines() if "\t" in line]
    assert (header[4], header[7]) == ("minus optimal", "interval")
    cells = [f"ippo: lr {rate}" for rate in ("5e-4", "5e-3")]
    assert {row[1] for row in rows} == {"rule random", "rule optimal", *cells}
    optimal = next(float(row[3]) for row in rows if row[1] == "rule optimal")
    for row in rows:
        if row[1] != "rule optimal":
            assert float(row[4]) == pytest.approx(float(row[3]) - optimal, abs=1e-3)
            assert float(row[5]) <= float(row[4]) <= float(row[6])
            assert row[7] == "t over episodes"
    assert "1 seed: the interval is over episodes" in shown.err


@pytest.mark.slow
def test_rules_to_compare_with_are_chosen(searched: Searched, rows_of: RowsOf) -> None:
    words = ("--store", str(searched.root), "--episodes", "2", "--rules", "random")
    header, *rows = rows_of("compare", "search_toy_matrix", *words)
    assert header[4] == "minus random"
    assert [row[1] for row in rows if row[1].startswith("rule ")] == ["rule random"]


@pytest.mark.slow
def test_no_winner_is_named_while_another_session_trains_a_seed(
    searched: Searched, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(Runner, "final_rewards", lambda self: [[1.0], []])
    assert run(["search", *SMALL, f"store.root={searched.root}"]) == 2
    last = capsys.readouterr().err.splitlines()[-1]
    assert "ippo: lr 5e-3 has 0 of 1 seeds, because another session" in last


@pytest.mark.parametrize(
    ("content", "line"),
    [
        ("", "must have the keys base, cells and candidates"),
        ("base: [experiment=toy_matrix]\ncells: {a: []}\ncandidates: {}", "candidates must have one entry"),
        ("base: [experiment=toy_matrix]\ncells: {a: }\ncandidates: {b: []}", "search/broken.cells.a"),
        ("base: [experiment=toy_matrix]\nname: c\ncells: {a: []}\ncandidates: {b: []}", "name is not a key"),
        ("base: [", "is not valid YAML"),
    ],
)
def test_a_broken_search_is_one_line(content: str, line: str, tmp_path: Path) -> None:
    (tmp_path / "search").mkdir()
    (tmp_path / "search" / "broken.yaml").write_text(content)
    with own_configs(str(tmp_path)), pytest.raises(HeadwayError) as raised:
        read_search("broken")
    assert line in str(raised.value)
    assert "\n" not in str(raised.value)


@pytest.mark.slow
def test_the_installed_program_tells_a_wrong_search_in_one_line() -> None:
    program = str(Path(sys.executable).with_name("headway"))
    done = subprocess.run([program, "search", "bus_lin"], capture_output=True, text=True, timeout=120)
    assert done.returncode == 2
    assert done.stderr.startswith("headway: there is no search 'bus_lin'; did you mean bus_line?")
    assert done.stderr.count("\n") == 1


def test_candidates_that_an_override_makes_equal_are_refused(refused: Refused) -> None:
    line = refused("search", "toy_matrix", "algo.lr=1e-3")
    assert "ippo: lr 5e-4 and ippo: lr 5e-3 are the same experiment" in line


@pytest.mark.slow
def test_wrong_words_for_a_plot_are_one_line(searched: Searched, tmp_path: Path, refused: Refused) -> None:
    absent = str(tmp_path / "absent" / "x.png")
    for words, line in (
        (("search_toy_matri",), "no study 'search_toy_matri'"),
        (("search_toy_matrix", "--metric", "evaluation_greedy/retrun"), "evaluation_greedy/return"),
        (("search_toy_matrix", "--output", absent), "cannot be written"),
    ):
        assert line in refused("plot", *words, "--store", str(searched.root))
