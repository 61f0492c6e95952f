"""What the lines of `headway plot` are called."""

from dataclasses import replace
from pathlib import Path

from headway.store import RunIndex, RunRecord
from headway.store.folder import Process, create_run_folder, now
from headway_launch.commands.plot import _labelled, _near


def _run(root: Path, policies: str, **parameters: str) -> None:
    run_id, directory = create_run_folder(root, "study", "cell", 0)
    record = RunRecord(run_id, "study", "bus", "ippo", 0, 10, now(), Process.current(), "FINISHED", policies)
    replace(record, parameters={"env.id": "bus", **parameters}).write(directory)


def test_cells_of_a_study_are_told_apart_by_what_differs(tmp_path: Path) -> None:
    for rate in ("0.001", "0.01"):
        _run(tmp_path, "shared", **{"algo.lr": rate})
    _run(tmp_path, "independent", **{"algo.lr": "0.001"})
    labels = [label for label, _ in _labelled([[row] for row in RunIndex(tmp_path).rows()])]
    assert sorted(labels) == [
        "ippo, independent, bus",
        "ippo, shared, bus, algo.lr 0.001",
        "ippo, shared, bus, algo.lr 0.01",
    ]


def test_a_rule_far_away_does_not_flatten_the_picture() -> None:
    rules = {"random": -1819.0, "always_move": 104.0, "even_headway": 240.0}
    assert _near(rules, 90.0, 250.0) == {"always_move", "even_headway"}
    assert _near(rules, -1800.0, 250.0) == set(rules)  # a curve that begins there
    # A flat curve hides no rule: what is near is judged with the nearest rule in the picture.
    assert _near({"random": -0.5, "optimal": 11.0}, 3.9, 4.1) == {"random", "optimal"}
    assert _near({"random": -0.5}, 4.0, 4.0) == {"random"}
