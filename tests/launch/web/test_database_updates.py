"""The updates of a store's MLflow database while its pages are served."""

from pathlib import Path
from typing import Any

import pytest

from headway.config.experiment import StoreConfig
from headway.contracts import HeadwayError
from headway.store.atomic_files import read_json
from headway.store.parquet_log import RunLog
from headway.store.session import Cell, Run, SessionStore
from headway.store.tracking.client import Tracker, database_uri
from headway_launch.web import database_updates
from headway_launch.web.database_updates import DatabaseUpdates

PATIENCE_S = 60.0


def _begun(root: Path) -> Run:
    store = SessionStore(StoreConfig(root=str(root)))
    return Cell(store, "study", "bus", "mappo", {}).begin_run(0, "seed: 0\n", {}, iterations=10)


def _train(run: Run, *iterations: int) -> None:
    log = RunLog(run.directory)
    for iteration in iterations:
        row = {"iteration": iteration, "env_steps": 100 * iteration, "wall_s": 0.5 * iteration}
        log.append("curve", [{**row, "train/reward": float(iteration)}])
    log.commit(iterations[-1])
    run.durable(iterations[-1])


def _points(root: Path, run: Run) -> list[int]:
    from mlflow.tracking import MlflowClient

    client: Any = MlflowClient(database_uri(root))
    child = read_json(run.directory / "tracking.json")["run"]
    return sorted(entry.step for entry in client.get_metric_history(child, "train/reward"))


def test_points_of_a_live_run_arrive_with_each_update(tmp_path: Path) -> None:
    run = _begun(tmp_path)
    _train(run, 1, 2)
    updates = DatabaseUpdates(tmp_path)
    assert not updates.has_views
    updates.update()
    assert updates.has_views
    assert _points(tmp_path, run) == [100, 200]
    _train(run, 3)
    updates.update()
    updates.update()
    assert _points(tmp_path, run) == [100, 200, 300]


def test_an_unreadable_run_is_printed_once(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = _begun(tmp_path)
    (run.directory / "run.json").write_text("{")
    updates = DatabaseUpdates(tmp_path)
    for _ in range(2):
        updates.update()
    assert capsys.readouterr().err.count("MLflow's database is not up to date: ") == 1


def test_an_error_is_printed_and_ends_the_wait(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Errors that are not Headway's, such as a full disk for temporary files, are included."""

    def fail(root: Path) -> None:
        raise OSError("no space left on device")

    monkeypatch.setattr(database_updates, "sync", fail)
    DatabaseUpdates(tmp_path).start(PATIENCE_S)
    told = capsys.readouterr().err
    assert told.count("no space left on device") == 1
    assert "are being sent" not in told


def test_a_database_that_cannot_be_made_is_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def refuse(root: Path) -> Tracker:
        raise HeadwayError("cannot create mlflow.db (Permission denied)")

    monkeypatch.setattr(database_updates, "Tracker", refuse)
    DatabaseUpdates(tmp_path)
    assert capsys.readouterr().err.count("\n") == 1
