"""`headway search` finds the best candidates by real runs; `headway compare` shows its study."""

import io
import json
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

import pytest
import yaml
from command_lines import output, refused

from headway.stats.best_of import expected_best
from headway.store.index import RunIndex
from headway_launch.commands.main import run
from headway_launch.experiments.compose import compose
from headway_launch.experiments.options import own_configs
from headway_launch.studies.search_results import order_lines

pytest.importorskip("optuna", reason='Optuna is not installed: pip install "headway[search]"')

SMALL = ("toy_tracking", "candidates=4", "env_steps=2048", "rungs=[1_024]", "backend=serial", "energy=off")


@dataclass(frozen=True)
class Searched:
    """A store with the runs of a search, and what the search printed."""

    root: Path
    out: str
    err: str

    def tables(self) -> list[list[list[str]]]:
        return [
            [line.split("\t") for line in table.splitlines() if "\t" in line]
            for table in self.out.split("\n\n")
        ]


@pytest.fixture(scope="module")
def searched(tmp_path_factory: pytest.TempPathFactory) -> Searched:
    root = tmp_path_factory.mktemp("store")
    with redirect_stdout(io.StringIO()) as out, redirect_stderr(io.StringIO()) as err:
        assert run(["search", *SMALL, f"store.root={root}"]) == 0
    return Searched(root, out.getvalue(), err.getvalue())


@pytest.mark.slow
def test_a_search_shows_the_best_their_cost_and_the_expected_best(searched: Searched) -> None:
    best, spent, expected = searched.tables()
    assert best[0] == ["algorithm", "candidate", "score", "steps", "settings"]
    assert [row[0] for row in best[1:]] == ["ippo"] * 3 + ["mappo"] * 3
    for rows in (best[1:4], best[4:]):
        assert [row[3] for row in rows] == ["2048", "2048", "1024"]
        assert float(rows[0][2]) >= float(rows[1][2])
        assert "algo.lr=" in rows[0][4]
    # Four candidates to step 1,024 and two of them to 2,048.
    assert [row[:5] for row in spent[1:]] == [
        [name, "4 of 4", "2", "0", "6144"] for name in ("ippo", "mappo")
    ]
    assert all(float(row[5]) > 0 for row in spent[1:])
    assert [row[0] for row in expected] == ["candidates n", "1", "2", "4"]
    assert searched.out.splitlines()[-1].startswith("n = ")
    assert (searched.root / "searches" / "search_toy_tracking.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.slow
def test_its_preset_trains_as_the_best_candidate(searched: Searched) -> None:
    """What the experiment sets itself is named."""
    folder = searched.root / "searches"
    content = yaml.safe_load((folder / "preset" / "search_toy_tracking.yaml").read_text())
    assert set(content) == {"ippo", "mappo"}
    with own_configs(str(folder)):
        experiment = compose(["experiment=toy_tracking", "preset=search_toy_tracking", "algo=mappo"])
    assert experiment.algo_config.lr == content["mappo"]["algo"]["lr"]
    assert "experiment=toy_tracking preset=search_toy_tracking algo=ippo,mappo seed=0..9" in searched.err
    assert "over any preset" not in searched.err


@pytest.mark.slow
def test_a_search_given_again_or_shown_trains_nothing(searched: Searched) -> None:
    for option in ((), ("--show",)):
        assert output("search", *SMALL, f"store.root={searched.root}", *option).out == searched.out
    assert len(RunIndex(searched.root).rows("search_toy_tracking")) == 8


@pytest.mark.slow
def test_the_rest_of_a_search_is_no_study_to_resume(searched: Searched) -> None:
    line = refused("resume", "--study", "search_toy_tracking", "--store", str(searched.root))
    assert "study search_toy_tracking is a search" in line


@pytest.mark.slow
def test_cells_and_rules_are_compared_on_the_same_days(searched: Searched) -> None:
    words = ("compare", "search_toy_tracking", "--store", str(searched.root), "--episodes", "4")
    shown = output(*words)
    header, *lines = [line.split("\t") for line in shown.out.splitlines() if "\t" in line]
    rows = [line for line in lines if len(line) == len(header)]
    paired, *pairs = lines[len(rows) :]
    learners = [row[0] for row in rows if not row[0].startswith("rule ")]
    assert [tuple(pair[:2]) for pair in pairs] == list(combinations(learners, 2))
    assert paired == ["controller", "minus", "difference [95%]", "p", "p (Holm)", "seeds needed"]
    assert [pair[-1] for pair in pairs] == [""] * 6
    assert "p (Holm): corrected by Holm for 6 pairs" in shown.err
    assert header == ["controller", "seeds", "return", "return minus optimal [95%]"]
    assert {"rule random", "rule optimal"} < {row[0] for row in rows}
    assert len(rows) == 6
    exact = {
        row["controller"]: row for row in json.loads(output(*words, "--format", "json").out)[: len(rows)]
    }
    for row in rows:
        if row[0] != "rule optimal":
            found = exact[row[0]]
            assert found["difference"] == pytest.approx(found["mean"] - exact["rule optimal"]["mean"])
            assert found["95% low"] <= found["difference"] <= found["95% high"]
            assert found["interval"] == "t over episodes"
    assert "1 seed: the interval is over episodes" in shown.err


def test_a_search_that_has_not_begun_is_not_shown(tmp_path: Path) -> None:
    line = refused("search", "toy_tracking", f"store.root={tmp_path / 'runs'}", "--show")
    assert "search toy_tracking has not begun" in line
    assert not (tmp_path / "runs").exists()
    assert "there is no search 'bus_lin'; did you mean bus_line?" in refused("search", "bus_lin")


def test_the_order_of_algorithms_is_told_per_number_of_candidates() -> None:
    steady, lucky = expected_best([3.0, 3.0, 3.0]), expected_best([-1.0, 0.0, 9.0])
    curves = {"lucky": lucky, "steady": steady}
    # Alone, the lucky one is expected to reach 8/3; the better of two of its candidates, 44/9.
    assert order_lines(curves, False) == ["n = 1: steady, then lucky", "n = 2 to 3: lucky, then steady"]
    assert order_lines(curves, True)[-1].endswith("steady, then lucky")
    assert order_lines({"one": steady, "other": steady}, False) == ["n = 1 to 3: one = other"]
    assert order_lines({"steady": steady}, False) == []
