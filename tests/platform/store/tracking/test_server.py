"""The store with a real MLflow server: reachable, unreachable, disconnected during training, reconnected."""

import contextlib
import os
import select
import signal
import socket
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from command_lines import failed
from mlflow_server import free_port, start_server

from headway.config.experiment import StoreConfig
from headway.contracts import HeadwayError
from headway.store.checkpoint import save_checkpoint
from headway.store.parquet_log import RunLog
from headway.store.session import Cell, Run, SessionStore
from headway.store.tracking import thread
from headway.store.tracking.client import require_answer
from headway.store.tracking.sync import Synced, sync_each

ITERATIONS = 40
PATIENCE_S = 300.0


class Line:
    """TCP proxy of the server's port that can be cut, so that clients no longer reach the server."""

    def __init__(self, to: int) -> None:
        self.to, self.is_cut = to, False
        self._listening = socket.create_server(("127.0.0.1", 0))
        self.uri = f"http://127.0.0.1:{self._listening.getsockname()[1]}"
        threading.Thread(target=self._accept, daemon=True).start()

    def close(self) -> None:
        self._listening.close()

    def _accept(self) -> None:
        with contextlib.suppress(OSError):  # closed
            while True:
                client, _ = self._listening.accept()
                threading.Thread(target=self._serve, args=(client,), daemon=True).start()

    def _serve(self, client: socket.socket) -> None:
        with client, contextlib.suppress(OSError):
            if self.is_cut:
                return
            with socket.create_connection(("127.0.0.1", self.to)) as server:
                both = {client: server, server: client}
                while not self.is_cut:
                    for one in select.select(list(both), [], [], 0.05)[0]:
                        content = one.recv(2**16)
                        if not content:
                            return
                        both[one].sendall(content)


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[int]:
    """The port of a real MLflow server."""
    folder, port = tmp_path_factory.mktemp("server"), free_port()
    process = start_server(folder, port)
    yield port
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()


@pytest.fixture
def line(server: int) -> Iterator[Line]:
    found = Line(server)
    yield found
    found.close()


def train(run: Run, first: int, last: int) -> None:
    """Write what a training process and its session write from iteration `first` to `last`."""
    log = RunLog(run.directory)
    for iteration in range(first, last + 1):
        row = {"iteration": iteration, "env_steps": 100 * iteration, "wall_s": 0.5 * iteration}
        log.append("curve", [{**row, "train/reward": float(iteration)}])
    log.commit(last)
    save_checkpoint(run.directory / "checkpoints", last, {"at": last})
    run.durable(last)


def stored(uri: str, study: str, run_id: str) -> tuple[str, list[tuple[int, float]], dict[str, float]]:
    """Return (status, curve, metrics) of a run, read from the server."""
    from mlflow.tracking import MlflowClient

    client: Any = MlflowClient(uri)
    experiment = client.get_experiment_by_name(study).experiment_id
    [found] = client.search_runs([experiment], filter_string=f"tags.`headway.run_id` = '{run_id}'")
    history = client.get_metric_history(found.info.run_id, "train/reward")
    points = sorted((int(entry.step), float(entry.value)) for entry in history)
    return found.info.status, points, found.data.metrics


def expected(last: int) -> list[tuple[int, float]]:
    return [(100 * iteration, float(iteration)) for iteration in range(1, last + 1)]


@pytest.mark.slow
def test_a_server_that_reconnects_receives_everything_once(
    line: Line, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(thread, "_RETRY_SECONDS", 0.0)
    config = StoreConfig(root=str(tmp_path), tracking_uri=line.uri)
    store = SessionStore(config)
    cell = Cell(store, "lost", "bus", "mappo", {"algo.lr": 3e-4})
    first, second = (cell.begin_run(seed, "seed: 0\n", {}, iterations=ITERATIONS) for seed in (0, 1))
    train(first, 1, 10)
    deadline = time.monotonic() + PATIENCE_S
    while len(_points_of(line, "lost", first.run_id)) < 10:
        assert time.monotonic() < deadline
        time.sleep(0.2)
    line.is_cut = True
    train(first, 11, 20)
    train(second, 1, ITERATIONS)
    second.finish("FINISHED", {"final_reward": 7.0})
    notices: list[str] = []
    while not notices:
        assert time.monotonic() < deadline
        notices += store.notices()
        time.sleep(0.1)
    assert notices[0].startswith("MLflow is behind")
    assert "training goes on" in notices[0]
    assert "headway sync" in notices[0]
    line.is_cut = False
    train(first, 21, ITERATIONS)
    first.finish("FINISHED", {"final_reward": 8.0})
    cell.finish("FINISHED", {})
    assert any("responds again" in line for line in store.close())
    for run, reward in ((first, 8.0), (second, 7.0)):
        status, points, metrics = stored(line.uri, "lost", run.run_id)
        assert (status, metrics["summary/final_reward"]) == ("FINISHED", reward)
        assert points == expected(ITERATIONS)
    assert sync_each(tmp_path) == Synced()


def _points_of(line: Line, study: str, run_id: str) -> list[tuple[int, float]]:
    with contextlib.suppress(Exception):  # the run may not exist yet
        return stored(line.uri, study, run_id)[1]
    return []


@pytest.mark.slow
def test_the_next_session_sends_what_an_unreachable_server_missed(
    line: Line, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config = StoreConfig(root=str(tmp_path), tracking_uri=line.uri)
    store = SessionStore(config)
    cell = Cell(store, "away", "bus", "mappo", {})
    line.is_cut = True
    run = cell.begin_run(0, "seed: 0\n", {}, iterations=ITERATIONS)
    train(run, 1, ITERATIONS)
    run.finish("FINISHED", {"final_reward": 7.0})
    [notice] = store.close()
    assert "headway sync" in notice
    with pytest.raises(HeadwayError, match="cannot be reached"):
        SessionStore(config)
    local = Cell(SessionStore(StoreConfig(root=str(tmp_path))), "here", "bus", "mappo", {})
    live = local.begin_run(0, "seed: 0\n", {}, iterations=ITERATIONS)
    done = sync_each(tmp_path)  # the store's database gets its runs nevertheless
    assert (done.runs, len(done.failures)) == ((live.run_id,), 1)

    line.is_cut = False
    other = SessionStore(config)
    assert other.close() == ()
    assert stored(line.uri, "away", run.run_id)[:2] == ("FINISHED", expected(ITERATIONS))
    assert sync_each(tmp_path) == Synced()
    assert capsys.readouterr().out == ""  # MLflow would print the run's address


def test_an_unreachable_server_is_refused_at_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("headway_launch.runner.runner.compile_kernels_of", lambda experiments: None)
    uri = f"http://127.0.0.1:{free_port()}"
    told = failed("run", "env=trivial", "algo=ippo", "energy=off", f"store.tracking_uri={uri}")
    assert f"MLflow's server at {uri} cannot be reached" in told.splitlines()[-1]
    assert not list(tmp_path.rglob("run.json"))
    with pytest.raises(HeadwayError):
        SessionStore(StoreConfig(root=str(tmp_path), tracking_uri="ftp://nowhere"))
    with pytest.raises(HeadwayError, match=r"at http://me@127\.0\.0\.1:\d+ cannot be reached"):
        require_answer(uri.replace("//", "//me:secret@"))
