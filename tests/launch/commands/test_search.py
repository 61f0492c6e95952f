"""`headway search` finds a winner by real runs, and `headway plot` draws them."""

import argparse
import io
import subprocess
import sys
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path

import pytest

from headway.contracts.errors import HeadwayError
from headway.store.index import RunIndex
from headway_launch.commands import search
from headway_launch.commands.main import run
from headway_launch.experiments.search import read_search
from headway_launch.runner.runner import Runner


def _headway(*words: str) -> subprocess.CompletedProcess[str]:
    """Return what a command of this process gives."""
    with redirect_stdout(io.StringIO()) as out, redirect_stderr(io.StringIO()) as err:
        code = run(list(words))
    return subprocess.CompletedProcess(words, code, out.getvalue(), err.getvalue())


@pytest.fixture(scope="module")
def searched(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, subprocess.CompletedProcess[str]]:
    root = tmp_path_factory.mktemp("store")
    small = ("env_steps=2048", "backend=serial", "energy=off", f"store.root={root}")
    return root, _headway("search", "toy_matrix", *small)


@pytest.mark.slow
def test_a_search_names_one_winner_a_cell(searched: tuple[Path, subprocess.CompletedProcess[str]]) -> None:
    _, done = searched
    assert done.returncode == 0, done.stderr
    table = done.stdout[done.stdout.index("cell\tcandidate") :].splitlines()[1:]
    rows = [line.split("\t") for line in table if line]
    assert [row[1] for row in rows] == ["lr 5e-4", "lr 5e-3"]
    first, second = (float(row[2]) for row in rows)
    words = (
        ["tied best", "tied best"] if first == second else ["best", ""] if first > second else ["", "best"]
    )
    assert [row[3] for row in rows] == words


@pytest.mark.slow
def test_a_search_given_again_trains_nothing_and_names_the_same_winner(
    searched: tuple[Path, subprocess.CompletedProcess[str]],
) -> None:
    root, first = searched
    again = _headway(
        "search", "toy_matrix", "env_steps=2048", "backend=serial", "energy=off", f"store.root={root}"
    )
    assert again.returncode == 0, again.stderr
    assert "2 finished and skipped" in again.stderr
    winners = [done.stdout[done.stdout.index("cell\tcandidate") :] for done in (first, again)]
    assert winners[0] == winners[1]
    assert len(RunIndex(root).rows("search_toy_matrix")) == 2


@pytest.mark.slow
def test_a_study_is_drawn(searched: tuple[Path, subprocess.CompletedProcess[str]], tmp_path: Path) -> None:
    root, _ = searched
    picture = tmp_path / "curves.png"
    done = _headway("plot", "search_toy_matrix", "--store", str(root), "--output", str(picture))
    assert done.returncode == 0, done.stderr
    assert picture.read_bytes().startswith(b"\x89PNG")


@pytest.mark.slow
def test_cells_and_rules_are_compared_on_the_same_days(
    searched: tuple[Path, subprocess.CompletedProcess[str]],
) -> None:
    root, _ = searched
    done = _headway("compare", "search_toy_matrix", "--store", str(root), "--episodes", "4")
    assert done.returncode == 0, done.stderr
    header, *rows = [line.split("\t") for line in done.stdout.splitlines() if "\t" in line]
    assert (header[4], header[7]) == ("minus optimal", "interval")
    cells = [f"ippo: lr {rate}" for rate in ("5e-4", "5e-3")]
    assert {row[1] for row in rows} == {"rule random", "rule optimal", *cells}
    optimal = next(float(row[3]) for row in rows if row[1] == "rule optimal")
    for row in rows:
        if row[1] != "rule optimal":
            assert float(row[4]) == pytest.approx(float(row[3]) - optimal, abs=1e-3)
            assert float(row[5]) <= float(row[4]) <= float(row[6])
            assert row[7] == "t over episodes"
    assert "1 seed: the interval is over episodes" in done.stderr


@pytest.mark.slow
def test_no_winner_is_named_while_another_session_trains_a_seed(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    small = ("toy_matrix", "env_steps=1024", "backend=serial", "energy=off", f"store.root={tmp_path}")
    done = _headway("search", *small)
    assert done.returncode == 0, done.stderr
    monkeypatch.setattr(Runner, "final_rewards", lambda self: [[1.0], []])
    monkeypatch.setattr("headway_launch.console.threads.limit_threads", lambda: None)
    parser = argparse.ArgumentParser()
    search.add_arguments(parser)
    arguments = parser.parse_args(list(small))
    arguments.debug = False
    with pytest.raises(HeadwayError, match="ippo: lr 5e-3 has 0 of 1 seeds, because another session"):
        search.execute(arguments)


@pytest.mark.parametrize(
    ("content", "line"),
    [
        ("", "must have the keys base, cells and candidates"),
        ("base: [experiment=toy_matrix]\ncells: {}\ncandidates: {a: []}", "cells must have one entry"),
        ("base: [experiment=toy_matrix]\ncells: {a: []}\ncandidates: {}", "candidates must have one entry"),
        ("base: [experiment=toy_matrix]\ncells: {a: }\ncandidates: {b: []}", "search/broken.cells.a"),
        (
            "base: [experiment=toy_matrix]\ncells: {a: algo=ippo}\ncandidates: {b: []}",
            "search/broken.cells.a",
        ),
        ("base: [experiment=toy_matrix]\nname: c\ncells: {a: []}\ncandidates: {b: []}", "name is not a key"),
        ("base: [", "is not valid YAML"),
    ],
)
def test_a_broken_search_is_one_line(
    content: str, line: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    (tmp_path / "search").mkdir()
    (tmp_path / "search" / "broken.yaml").write_text(content)
    monkeypatch.setattr("headway_launch.experiments.search.configs_folder", lambda: tmp_path)
    with pytest.raises(HeadwayError) as raised:
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


@pytest.mark.slow
@pytest.mark.parametrize(
    ("words", "line"),
    [
        (("search", "toy_matrix", "algo.lrr=1"), "algo.lrr"),
        (("search", "toy_matrix", "algo.lr=1e-3"), "ippo: lr 5e-4 and ippo: lr 5e-3 are the same experiment"),
    ],
)
def test_a_wrong_search_is_one_line(words: tuple[str, ...], line: str) -> None:
    done = _headway(*words)
    assert done.returncode == 2
    assert line.lower() in done.stderr.lower()
    assert len(done.stderr.splitlines()) == 1


@pytest.mark.slow
def test_wrong_words_for_a_plot_are_one_line(
    searched: tuple[Path, subprocess.CompletedProcess[str]], tmp_path: Path
) -> None:
    root, _ = searched
    for words, line in (
        (("search_toy_matri",), "no study 'search_toy_matri'"),
        (("search_toy_matrix", "--metric", "evaluation_greedy/retrun"), "evaluation_greedy/return"),
        (("search_toy_matrix", "--output", str(tmp_path / "absent" / "x.png")), "cannot be written"),
    ):
        done = _headway("plot", *words, "--store", str(root))
        assert done.returncode == 2
        assert line in done.stderr
        assert len(done.stderr.splitlines()) == 1
