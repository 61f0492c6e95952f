"""Views of a run for a browser."""

import csv
from pathlib import Path

from headway.store.artifacts import write_views
from headway.store.parquet_log import RunLog


def test_evaluations_become_a_table_and_curves_a_picture(tmp_path: Path) -> None:
    log, views = RunLog(tmp_path / "run"), tmp_path / "views"
    views.mkdir()
    for iteration in range(4):
        row = {"iteration": iteration, "env_steps": 10 * iteration, "wall_s": 0.5, "training/return": 1.0}
        measured = {"evaluation_greedy/return": 7.0 + iteration} if iteration % 2 == 0 else {}
        log.append("curve", [{**row, **measured}])
    log.commit(3)
    table, picture = write_views(tmp_path / "run", "a run", views)
    assert (table, picture) == (views / "evaluations.csv", views / "curves.png")
    with table.open() as stream:
        rows = list(csv.DictReader(stream))
    assert [row["env_steps"] for row in rows] == ["0", "20"]
    assert [row["evaluation_greedy/return"] for row in rows] == ["7.0", "9.0"]
    assert "training/return" not in rows[0]
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_a_run_without_a_curve_has_no_views(tmp_path: Path) -> None:
    assert write_views(tmp_path, "a run", tmp_path) == []
    assert list(tmp_path.iterdir()) == []
