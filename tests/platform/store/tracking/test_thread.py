"""The thread that follows runs into MLflow: what is sent, how often, and what an outage changes."""

import threading
from pathlib import Path

import pytest

from headway.config.experiment import StoreConfig
from headway.contracts import HeadwayError
from headway.store.session import Cell, SessionStore
from headway.store.tracking import thread
from headway.store.tracking.client import Tracker, TrackingError, database_uri
from headway.store.tracking.sync import RunSync, Synced
from headway.store.tracking.thread import TrackingThread

PATIENCE_S = 60.0


def test_a_run_is_sent_again_only_if_it_has_changed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    cell = Cell(SessionStore(StoreConfig(root=str(tmp_path))), "study", "bus", "mappo", {})
    run = cell.begin_run(0, "seed: 0\n", {}, iterations=10)
    tracker, asked = Tracker(tmp_path), []
    ask = Tracker._ask

    def count(self: Tracker, method: str, *arguments: object, **named: object) -> object:
        asked.append(method)
        return ask(self, method, *arguments, **named)

    monkeypatch.setattr(Tracker, "_ask", count)
    sync = RunSync(run.directory)
    sync.send(tracker)
    assert asked
    asked.clear()
    sync.send(tracker)
    assert not asked
    run.finish("FINISHED", {})
    sync.send(tracker)
    assert "set_terminated" in asked


@pytest.mark.slow
@pytest.mark.parametrize("outage", [1, 2])
def test_what_fails_at_the_end_is_tried_once_more(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, outage: int
) -> None:
    attempts = []

    def fail(root: Path, tracking_uri: str, only_own: bool) -> Synced:
        attempts.append(tracking_uri)
        if len(attempts) <= outage:
            raise TrackingError("MLflow is away")
        return Synced()

    monkeypatch.setattr(thread, "sync", fail)
    mlflow = TrackingThread(tmp_path, database_uri(tmp_path))
    mlflow.close(PATIENCE_S)
    behind, *again = mlflow.notices()
    assert len(attempts) == 2
    assert behind.startswith("MLflow is behind (MLflow is away)")
    assert len(again) == (1 if outage == 1 else 0)


def test_after_a_failed_connection_nothing_retries(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(root: Path, tracking_uri: str) -> Tracker:
        raise TrackingError("no such server")

    monkeypatch.setattr(thread, "Tracker", refuse)
    with pytest.raises(HeadwayError, match="no such server"):
        TrackingThread(tmp_path, database_uri(tmp_path))
    assert "headway-mlflow" not in {each.name for each in threading.enumerate()}
