"""Candidates drawn by Optuna: the same ones for the same seed, wherever a search was interrupted."""

from pathlib import Path
from typing import Any

import pytest

from headway.contracts.errors import HeadwayError
from headway_launch.experiments.search import AlgorithmSearch, Search
from headway_launch.experiments.search_space import dimensions
from headway_launch.studies.trials import Trial, Trials

pytest.importorskip("optuna", reason='Optuna is not installed: pip install "headway[search]"')

SPACE = {
    "algo.lr": {"low": 1e-4, "high": 1e-2, "log": True},
    "algo.epochs": {"low": 1, "high": 8},
    "algo.clip": [0.1, 0.2, 0.3],
}
GRID = {"algo.epochs": {"low": 1, "high": 3}, "algo.clip": [0.1, 0.2]}


def part(label: str = "ippo", space: dict[str, Any] = SPACE, **keys: object) -> AlgorithmSearch:
    settings = {"base": (), "algorithms": {label: ()}, "candidates": 8, "env_steps": 100, "batch": 4, **keys}
    search = Search(**settings)
    overrides = ("env=trivial", f"algo={label}")
    return AlgorithmSearch(label, dimensions(space, "space"), overrides, search, search.candidates)


def score(trial: Trial) -> float:
    return -abs(float(trial.values["algo.epochs"]) - 4) - float(trial.values["algo.clip"])


def searched(trials: Trials, count: int = 8, batch: int = 4) -> list[Trial]:
    """Return all candidates of a search, each batch ended before the next is drawn."""
    for first in range(0, count, batch):
        for trial in trials.draw(first + batch)[first:]:
            trials.report(trial.number, 100, score(trial))
            trials.end(trial.number, "COMPLETE" if trial.number % 2 else "PRUNED")
    return trials.all()


@pytest.mark.parametrize("sampler", ["random", "tpe"])
def test_the_same_seed_draws_the_same_candidates(sampler: str, tmp_path: Path) -> None:
    """In memory and in a database, and also if drawing was interrupted after any candidate."""
    unbroken = searched(Trials(part(sampler=sampler), None))
    assert {trial.state for trial in unbroken} == {"COMPLETE", "PRUNED"}
    assert [trial.score for trial in unbroken] == [score(trial) for trial in unbroken]
    Trials(part(sampler=sampler), tmp_path / "one.db").draw(2)
    assert searched(Trials(part(sampler=sampler), tmp_path / "one.db")) == unbroken
    other = searched(Trials(part(sampler=sampler, sampler_seed=1), None))
    assert [trial.values for trial in other] != [trial.values for trial in unbroken]


def test_tpe_learns_from_earlier_batches_only() -> None:
    random, tpe = (searched(Trials(part(sampler=name), None)) for name in ("random", "tpe"))
    values = [[trial.values for trial in trials] for trials in (random, tpe)]
    assert values[0][:4] == values[1][:4]
    assert values[0][4:] != values[1][4:]


def test_algorithms_with_equal_spaces_try_equal_random_candidates() -> None:
    ippo, mappo = (Trials(part(name), None).draw(4) for name in ("ippo", "mappo"))
    assert [trial.values for trial in ippo] == [trial.values for trial in mappo]


def test_a_grid_has_every_combination_once(tmp_path: Path) -> None:
    grid = part(space=GRID, sampler="grid", candidates=6, batch=3)
    trials = searched(Trials(grid, tmp_path / "grid.db"), 6, 3)
    assert len({tuple(trial.values.values()) for trial in trials}) == 6
    again = [trial.values for trial in Trials(grid, None).draw(6)]
    assert again == [trial.values for trial in trials]
    other = part(space=GRID, sampler="grid", candidates=6, batch=3, sampler_seed=3)
    assert again != [trial.values for trial in Trials(other, None).draw(6)]


def test_values_lie_in_their_dimensions() -> None:
    for trial in Trials(part(candidates=40), None).draw(40):
        assert 1e-4 <= float(trial.values["algo.lr"]) <= 1e-2
        assert trial.values["algo.epochs"] in range(1, 9)
        assert trial.values["algo.clip"] in ("0.1", "0.2", "0.3")


def test_a_database_of_other_settings_is_refused_and_kept(tmp_path: Path) -> None:
    path = tmp_path / "one.db"
    before = Trials(part(), path).draw(4)
    with pytest.raises(HeadwayError, match="this search has begun with sampler='random', not 'tpe'"):
        Trials(part(sampler="tpe"), path).require_settings()
    assert Trials(part(candidates=12), path).draw(12)[:4] == before
    bad = tmp_path / "bad.db"
    bad.write_text("no database")
    with pytest.raises(HeadwayError, match="cannot be used as Optuna's database"):
        Trials(part(), bad)
    assert bad.read_text() == "no database"


def test_a_missing_optuna_is_one_line(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setitem(__import__("sys").modules, "optuna", None)
    with pytest.raises(
        HeadwayError, match=r"needs Optuna, which is an extra: pip install .headway\[search\]"
    ):
        Trials(part(), tmp_path / "searches" / "one.db")
    assert not any(tmp_path.iterdir())
