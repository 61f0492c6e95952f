"""The thread that sends updates to MLflow: what is sent, how often, and what an outage changes."""

import threading
import time
from pathlib import Path

import pytest

from headway.contracts import HeadwayError
from headway.store.tracking import thread
from headway.store.tracking.client import Tracker, TrackingError, database_uri
from headway.store.tracking.thread import TrackingThread

PATIENCE_S = 60.0


def test_an_update_that_is_pending_is_sent_once(tmp_path: Path) -> None:
    mlflow, sent = TrackingThread(tmp_path, database_uri(tmp_path)), []
    begun, free = threading.Event(), threading.Event()

    def block(tracker: Tracker) -> None:
        begun.set()
        assert free.wait(PATIENCE_S)

    def update(tracker: Tracker) -> None:
        sent.append(tracker)

    mlflow.submit(block)
    assert begun.wait(PATIENCE_S)
    for _ in range(3):
        mlflow.submit(update)
    free.set()
    mlflow.close(PATIENCE_S)
    assert len(sent) == 1
    assert mlflow.notices() == ()


@pytest.mark.slow
@pytest.mark.parametrize("outage", [1, 2])
def test_an_update_that_fails_at_the_end_is_tried_once_more(tmp_path: Path, outage: int) -> None:
    mlflow, attempts, after = TrackingThread(tmp_path, database_uri(tmp_path)), [], []
    mlflow.submit(lambda tracker: time.sleep(0.2))  # so that everything is sent in the last round

    def update(tracker: Tracker) -> None:
        attempts.append(tracker)
        if len(attempts) <= outage:
            raise TrackingError("MLflow is away")

    mlflow.submit(update)
    mlflow.submit(after.append)
    mlflow.close(PATIENCE_S)
    behind, *again = mlflow.notices()
    assert len(attempts) == 2
    assert behind.startswith("MLflow is behind (MLflow is away)")
    assert len(after) == len(again) == (1 if outage == 1 else 0)


def test_after_a_failed_connection_nothing_retries(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    attempts = []

    def refuse(root: Path, tracking_uri: str) -> Tracker:
        attempts.append(tracking_uri)
        raise TrackingError("no such server")

    monkeypatch.setattr(thread, "Tracker", refuse)
    monkeypatch.setattr(thread, "_RETRY_SECONDS", 0.05)
    mlflow = TrackingThread(tmp_path, database_uri(tmp_path))
    with pytest.raises(HeadwayError, match="no such server"):
        mlflow.connect()
    assert mlflow._thread is not None
    mlflow._thread.join(PATIENCE_S)
    assert not mlflow._thread.is_alive()
    assert len(attempts) < 10
