"""Session side of the store, with the real MLflow on SQLite."""

import os
import signal
import socket
import sqlite3
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import psutil
import pytest

from headway.config.experiment import StoreConfig
from headway.contracts import HeadwayError
from headway.events import Row
from headway.store.atomic_files import read_json
from headway.store.checkpoint import save_checkpoint
from headway.store.index import RunIndex
from headway.store.parquet_log import RunLog
from headway.store.run_folder import Process, read_rules, rules_file
from headway.store.session import Cell, Run, SessionStore
from headway.store.tracking.client import Tracker
from headway.store.tracking.sync import Synced, sync

ITERATIONS = 40


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """Root of a new store."""
    return tmp_path


@pytest.fixture(autouse=True)
def _no_network(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise AssertionError("the store used the network")

    monkeypatch.setattr(socket.socket, "connect", refuse)
    monkeypatch.setattr(socket, "getaddrinfo", refuse)


def _row(iteration: int) -> Row:
    steps = {"iteration": iteration, "env_steps": 100 * iteration, "wall_s": 0.5 * iteration}
    return {**steps, "train/reward": float(iteration), "train/loss": 1.0 / (1 + iteration)}


def _begin(store: SessionStore, seed: int = 0, algorithm: str = "mappo") -> Run:
    cell = Cell(store, "study one", "bus", algorithm, {"algo.lr": 3e-4})
    return cell.begin_run(seed, "seed: 0\n", {"copies": 8}, iterations=ITERATIONS, policies="shared")


def _train(run: Run, first: int, last: int) -> None:
    """Write what a training process and its session write from iteration `first` to `last`."""
    log = RunLog(run.directory)
    for iteration in range(first, last + 1):
        log.append("curve", [_row(iteration)])
        if iteration and iteration % 10 == 0:
            log.commit(iteration)
            save_checkpoint(run.directory / "checkpoints", iteration, {"at": iteration})
            run.durable(iteration)


def _histories(root: Path, run: Run) -> dict[str, list[tuple[int, float]]]:
    """Return the (step, value) pairs of each metric of a run, read from MLflow."""
    client, child = _mlflow(root), read_json(run.directory / "tracking.json")["run"]
    return {
        key: sorted((entry.step, entry.value) for entry in client.get_metric_history(child, key))
        for key in client.get_run(child).data.metrics
    }


def _mlflow(root: Path) -> Any:  # noqa: ANN401 - MLflow is not typed
    from mlflow.tracking import MlflowClient

    return MlflowClient(f"sqlite:///{root / 'mlflow.db'}")


def test_a_run_from_beginning_to_end(root: Path) -> None:
    store = SessionStore(StoreConfig(root=str(root), curve_points=11))
    cell = Cell(store, "study one", "bus", "mappo", {"algo.lr": 3e-4})
    chosen: tuple[dict[str, str], ...] = ({"preset": "merge_paper", "candidate": "own reward"}, {})
    runs = [
        cell.begin_run(seed, "seed: 0\n", {"copies": 8}, iterations=ITERATIONS, **names)
        for seed, names in enumerate(chosen)
    ]
    log = RunLog(runs[0].directory)
    log.append("curve", [{**_row(0), "evaluation_greedy/return": 1.0}])
    log.commit(0)
    for run in runs:
        _train(run, 1, ITERATIONS)
        run.energy.append({"elapsed_s": 5.0, "kwh": 0.001})
        run.finish("FINISHED", {"final_reward": -3.5, "auc": 0.6, "kwh": 0.002, "kg_co2": None})
    cell.finish("FINISHED", {"final_reward_mean": -3.5})
    assert store.close() == ()
    assert not list(root.glob("*/*/tracking*.json"))  # the session needs no MLflow
    assert set(sync(root).runs) == {run.run_id for run in runs}

    client = _mlflow(root)
    experiment = client.get_experiment_by_name("study one").experiment_id
    found = {entry.info.run_name: entry for entry in client.search_runs([experiment])}
    assert set(found) == {cell.name, *(run.run_id for run in runs)}
    child, parent = found[runs[0].run_id], found[cell.name]
    assert child.info.status == parent.info.status == "FINISHED"
    assert child.data.tags["mlflow.parentRunId"] == parent.info.run_id
    assert child.data.params == {"algo.lr": "0.0003"}
    assert child.data.metrics["summary/final_reward"] == -3.5
    assert "summary/kg_co2" not in child.data.metrics
    assert {"version.torch", "hardware.cpu"} <= set(child.data.tags)
    assert chosen[0].items() <= child.data.tags.items()
    assert chosen[0].keys().isdisjoint(found[runs[1].run_id].data.tags)  # not known
    artifacts = {artifact.path for artifact in client.list_artifacts(child.info.run_id)}
    assert {"config.yaml", "plan.json", "curve-000010.parquet", "energy.parquet"} <= artifacts
    assert {"curves.png", "evaluations.csv"} <= artifacts  # views for a browser

    curve = _histories(root, runs[1])["train/reward"]
    assert len(curve) <= 11
    assert curve[0] == (100, 1.0)
    assert curve[-1] == (4000, 40.0)


def test_only_durable_points_reach_mlflow(root: Path) -> None:
    store = SessionStore(StoreConfig(root=str(root)))
    run = _begin(store)
    _train(run, 0, 25)
    store.close()
    assert sync(root).runs == (run.run_id,)
    assert sync(root).runs == ()
    assert _statuses(root) == ["RUNNING"] * 2
    assert [step for step, _ in _histories(root, run)["train/reward"]] == [100 * i for i in range(21)]
    assert (run.record.durable_iteration, run.record.durable_env_steps) == (20, 2000)


def test_a_resumed_run_sends_each_point_once(root: Path) -> None:
    config = StoreConfig(root=str(root))
    first = SessionStore(config)
    run = _begin(first)
    _train(run, 0, 25)
    run.energy.append({"kwh": 0.25})
    run.finish("KILLED", {"final_reward": 0.5})
    first.close()
    sync(root)

    second = SessionStore(config)
    [resumed] = second.resume([run.run_id])
    assert resumed.energy.last() == {"kwh": 0.25}
    RunLog(resumed.directory).rewind(20)
    resumed.note_restart(20)
    _train(resumed, 21, ITERATIONS - 10)
    sync(root)  # in mid-training
    _train(resumed, ITERATIONS - 9, ITERATIONS)
    resumed.finish("FINISHED", {"final_reward": 1.0})
    assert second.close() == ()
    assert sync(root).runs == (run.run_id,)
    expected = [(100 * i, float(i)) for i in range(ITERATIONS + 1)]
    assert _histories(root, run)["train/reward"] == expected
    # The summary of the killed run was not sent: it is not the result.
    assert _histories(root, run)["summary/final_reward"] == [(0, 1.0)]
    child = _mlflow(root).get_run(read_json(run.directory / "tracking.json")["run"])
    assert child.data.tags["episodes_restarted"] == "20"
    [row] = RunIndex(root).rows()
    assert (row.status, row.iterations, row.final_reward) == ("FINISHED", ITERATIONS, 1.0)
    with pytest.raises(HeadwayError, match="has finished"):
        second.resume([run.run_id])


def test_the_time_of_a_killed_session_counts_up_to_its_last_checkpoint(
    root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = 1000.0
    monkeypatch.setattr("headway.store.session.time.monotonic", lambda: clock)
    run = _begin(SessionStore(StoreConfig(str(root))))
    clock = 1070.0
    _train(run, 0, 10)
    clock = 1095.0  # killed here
    monkeypatch.setattr(Process, "may_live", lambda process: False)
    clock = 5000.0
    [resumed] = SessionStore(StoreConfig(str(root))).resume([run.run_id])
    clock = 5030.0
    assert resumed.duration_s == 100.0
    _train(resumed, 11, 20)
    clock = 5037.0
    resumed.finish("FINISHED", {})
    assert resumed.record.duration_s == 107.0
    clock = 6000.0
    resumed.durable(20)  # for the rest of its stack, in a later session
    assert resumed.record.duration_s == 107.0


def test_steps_after_the_checkpoint_that_training_resumes_from_do_not_count(root: Path) -> None:
    run = _begin(SessionStore(StoreConfig(str(root))))
    _train(run, 0, 20)
    assert (run.record.durable_iteration, run.record.durable_env_steps) == (20, 2000)
    log = RunLog(run.directory)
    log.rewind(10)  # the checkpoint of iteration 20 was broken
    log.append("curve", [_row(iteration) for iteration in range(11, 16)])
    log.commit(15)
    run.durable(15)
    assert (run.record.durable_iteration, run.record.durable_env_steps) == (15, 1500)


def test_a_finished_run_of_a_killed_stack_keeps_its_summary(root: Path) -> None:
    """The session died between the ends of the stack's two runs, and the rest is resumed with both."""
    config = StoreConfig(root=str(root))
    first = SessionStore(config)
    runs = [_begin(first, seed) for seed in (0, 1)]
    for run in runs:
        _train(run, 0, ITERATIONS)
    runs[0].finish("FINISHED", {"cpu_seconds": 7.0})
    runs[1].finish("KILLED", {"cpu_seconds": 7.0})
    first.close()
    sync(root)

    second = SessionStore(config)
    for run in second.resume([run.run_id for run in runs]):
        run.finish("FINISHED", {"cpu_seconds": 8.0})
    assert second.close() == ()
    sync(root)
    assert [_histories(root, run)["summary/cpu_seconds"] for run in runs] == [[(0, 7.0)], [(0, 8.0)]]
    assert [row.cpu_seconds for row in RunIndex(root).rows()] == [7.0, 8.0]


def test_rules_stored_by_earlier_sessions_stay(root: Path) -> None:
    store = SessionStore(StoreConfig(root=str(root)))
    cell = Cell(store, "study one", "bus", "mappo", {})
    cell.begin_run(0, "seed: 0\n", {}, iterations=ITERATIONS)
    once, again, other = ([{"episode_seed": 0, "return": value}] for value in (1.0, 2.0, 3.0))
    cell.keep_rules({"held": once, "random": again})
    cell.keep_rules({})
    cell.keep_rules({"random": other})
    assert read_rules(root, "study one", cell.name) == {"held": once, "random": other}
    rules_file(root, "study one", cell.name).write_text('{"held": [')
    cell.keep_rules({"random": other})
    assert read_rules(root, "study one", cell.name) == {"random": other}
    store.close()


def test_a_running_run_is_not_taken_over(root: Path) -> None:
    store = SessionStore(StoreConfig(root=str(root)))
    run = _begin(store)
    with pytest.raises(HeadwayError, match=f"process {os.getpid()}"):
        store.resume([run.run_id])
    with pytest.raises(HeadwayError, match="the nearest is bus-mappo"):
        store.resume(["bus-mapo"])
    with pytest.raises(HeadwayError, match=r"no run 'nosuch' in .*: `headway runs` lists the runs"):
        store.resume(["nosuch"])
    with pytest.raises(
        HeadwayError, match=rf"'study one' is a study .* of its runs, {run.run_id.rsplit('-', 3)[0]}$"
    ):
        store.resume(["study one"])
    store.close()


def _statuses(root: Path) -> list[str]:
    """Return the statuses of runs and cells in MLflow, sorted."""
    return sorted(run.info.status for run in _mlflow(root).search_runs(["1"]))


def test_a_broken_database_is_one_line_and_nothing_is_sent_twice(root: Path) -> None:
    Tracker(root)
    whole = (root / "mlflow.db").read_bytes()
    (root / "mlflow.db").write_bytes(b"no database at all" * 100)
    store = SessionStore(StoreConfig(root=str(root)))
    run = _begin(store)
    _train(run, 1, ITERATIONS)
    run.finish("FINISHED", {"final_reward": 2.0})
    assert store.close() == ()
    with pytest.raises(HeadwayError, match=r"^MLflow at sqlite:///.*mlflow\.db failed: [^\n]*$"):
        sync(root)

    (root / "mlflow.db").write_bytes(whole)
    assert sync(root) == Synced((run.run_id,))
    assert sync(root) == Synced()
    histories = _histories(root, run)
    assert histories["train/loss"][-1] == (4000, 1 / 41)
    assert histories["summary/final_reward"] == [(0, 2.0)]
    assert _statuses(root) == ["FINISHED"] * 2  # the run and its cell, which no session ended

    # After a crash between sending and recording it, nothing is sent twice.
    (run.directory / "tracking.json").unlink()
    assert sync(root) == Synced((run.run_id,))
    assert _histories(root, run) == histories
    assert _statuses(root) == ["FINISHED"] * 2


def _cell_metrics(root: Path, name: str) -> dict[str, list[float]]:
    """Return the values of each metric of a cell's parent run in MLflow."""
    client = _mlflow(root)
    [parent] = client.search_runs(["1"], filter_string=f"tags.`headway.cell` = '{name}'")
    return {
        key: [entry.value for entry in client.get_metric_history(parent.info.run_id, key)]
        for key in parent.data.metrics
    }


def test_data_of_a_cell_reach_mlflow_later_and_once(root: Path) -> None:
    """This includes cells whose runs are complete in MLflow; values of earlier sessions stay."""
    config = StoreConfig(root=str(root))
    store = SessionStore(config)
    cell = Cell(store, "study one", "bus", "mappo", {"algo.lr": 3e-4})
    run = cell.begin_run(0, "seed: 0\n", {}, iterations=ITERATIONS)
    _train(run, 1, 10)
    run.finish("FINISHED", {"final_reward": 2.0})
    assert store.close() == ()
    assert sync(root).runs == (run.run_id,)
    for metrics in ({"energy_total_kwh": 0.5, "rules/held_return": 3.0}, {"rules/held_return": 4.0}):
        later = SessionStore(config)
        Cell(later, "study one", "bus", "mappo", {"algo.lr": 3e-4}).finish("FINISHED", metrics)
        assert later.close() == ()

    for _ in range(2):
        assert sync(root) == Synced()
        sent = _cell_metrics(root, cell.name)
        assert sent == {"summary/energy_total_kwh": [0.5], "summary/rules/held_return": [4.0]}
    [path] = root.glob("*/*.summary.json")
    path.write_text("{}")
    (run.directory / "tracking.json").unlink()
    sent, problems, *_ = sync(root)
    assert sent == (run.run_id,)
    assert any(f"{path} is not the summary of a cell" in line for line in problems)


def test_a_device_in_a_run_folder_is_not_sent(root: Path) -> None:
    """A pipe, with which the sending session would hang, is not sent either."""
    store = SessionStore(StoreConfig(root=str(root)))
    run = _begin(store)
    _train(run, 1, ITERATIONS)
    (run.directory / "episodes-000002.parquet").symlink_to("/dev/null")
    run.finish("FINISHED", {"final_reward": 2.0})
    assert not store.close()
    sync(root)
    sent = {path.name for path in (root / "mlflow-artifacts").rglob("*.*")}
    assert "run.json" in sent
    assert "episodes-000002.parquet" not in sent


def test_an_unreadable_run_does_not_block_other_runs(root: Path) -> None:
    store = SessionStore(StoreConfig(root=str(root)))
    broken, whole = _begin(store, seed=0), _begin(store, seed=1)
    for run in (broken, whole):
        _train(run, 1, 10)
        run.finish("KILLED" if run is broken else "FINISHED", {"final_reward": 1.0})
    store.close()
    segment = broken.directory / "curve-000010.parquet"
    content = segment.read_bytes()
    segment.write_bytes(b"no Parquet")
    sent, [problem], *_ = sync(root)
    assert sent == (whole.run_id,)
    assert problem.startswith(f"{broken.run_id} is not sent to MLflow: ")
    assert "curve-000010.parquet cannot be read as Parquet" in problem

    segment.write_bytes(content)
    (whole.directory / "tracking.json").write_text("{half of it")  # broken: MLflow is queried instead
    sent, problems, *_ = sync(root)
    assert (set(sent), problems) == ({broken.run_id, whole.run_id}, ())
    assert sync(root) == Synced()
    assert _histories(root, whole)["summary/final_reward"] == [(0, 1.0)]
    assert len(_histories(root, broken)["train/reward"]) == 10
    assert _statuses(root) == ["FINISHED", "KILLED", "KILLED"]  # the cell has the worse status of its runs


@pytest.fixture
def short_lock_wait() -> Iterator[None]:
    """Shorten MLflow's own wait for a lock from 20 s to 0.1 s."""
    import sqlalchemy

    def shorten(_connection: object, _cursor: object, statement: str, parameters: Any, *_: object) -> Any:  # noqa: ANN401
        return statement.replace("busy_timeout = 20000", "busy_timeout = 100"), parameters

    sqlalchemy.event.listen(sqlalchemy.Engine, "before_cursor_execute", shorten, retval=True)
    yield
    sqlalchemy.event.remove(sqlalchemy.Engine, "before_cursor_execute", shorten)


@pytest.mark.slow
@pytest.mark.usefixtures("short_lock_wait")
def test_the_wait_for_a_locked_database_is_bounded(root: Path) -> None:
    other = sqlite3.connect(root / "mlflow.db", isolation_level=None)
    tracker = Tracker(root, wait_s=0.5)
    other.execute("BEGIN EXCLUSIVE")
    with pytest.raises(HeadwayError, match=r"stayed locked for 0\.5 s"):
        tracker.cell("study", "cell", {}, {})
    other.execute("ROLLBACK")
    other.close()
    tracker.cell("study", "cell", {}, {})


_ONE_OF_TWO = """
import sys, time
root, folder, seed, moment = sys.argv[1:]
sys.path.insert(0, folder)
from test_session import StoreConfig, SessionStore, _begin, _train, sync
time.sleep(max(0.0, float(moment) - time.time()))
store = SessionStore(StoreConfig(root=root))
run = _begin(store, int(seed))
_train(run, 1, 10)
run.finish("FINISHED", {"final_reward": float(seed)})
store.close()
sys.exit("; ".join(sync(store.root).problems) or 0)
"""


@pytest.mark.slow
def test_two_processes_can_make_the_database_of_a_new_store_together(tmp_path: Path) -> None:
    moment, here = str(time.time() + 1.5), str(Path(__file__).parent)
    commands = [
        [sys.executable, "-c", _ONE_OF_TWO, str(tmp_path), here, str(seed), moment] for seed in range(2)
    ]
    sessions = [subprocess.Popen(command) for command in commands]
    assert [session.wait(300) for session in sessions] == [0, 0]
    assert sorted(row.final_reward or 0.0 for row in RunIndex(tmp_path).rows()) == [0, 1]
    client = _mlflow(tmp_path)
    assert len(client.search_experiments()) == 2
    # One parent for the cell that both share, and each curve once.
    found = client.search_runs(["1"])
    points = sorted(len(client.get_metric_history(run.info.run_id, "train/reward")) for run in found)
    assert points == [0, 10, 10]


_KILLED = """
import sys
sys.path.insert(0, sys.argv[2])
from test_session import RunIndex, StoreConfig, SessionStore, _begin, _train
store = SessionStore(StoreConfig(root=sys.argv[1]))
run = _begin(store)
_train(run, 1, 25)
print(run.run_id, flush=True)
import time
time.sleep(60)
"""


@pytest.mark.slow
def test_a_killed_session_leaves_a_run_that_can_be_resumed(root: Path) -> None:
    command = [sys.executable, "-c", _KILLED, str(root), str(Path(__file__).parent)]
    session = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    assert session.stdout is not None
    run_id = session.stdout.readline().strip()
    assert [row.status for row in RunIndex(root).rows()] == ["RUNNING"]
    session.send_signal(signal.SIGKILL)
    session.wait()
    session.stdout.close()
    [row] = RunIndex(root).rows()
    assert (row.run_id, row.status, row.iterations) == (run_id, "KILLED", 20)
    sync(root)

    store = SessionStore(StoreConfig(root=str(root)))
    [run] = store.resume([run_id])
    RunLog(run.directory).rewind(20)
    _train(run, 21, ITERATIONS)
    run.finish("FINISHED", {})
    assert store.close() == ()
    sync(root)
    assert len(_histories(root, run)["train/reward"]) == ITERATIONS


def test_a_killed_process_whose_parent_has_not_noticed_has_ended() -> None:
    child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"])
    process = Process(Process.current().host, child.pid, psutil.Process(child.pid).create_time())
    assert process.may_live()
    child.kill()
    os.waitid(os.P_PID, child.pid, os.WEXITED | os.WNOWAIT)
    assert not process.may_live()
    child.wait()
