"""Sessions whose workers run in a Ray cluster: the same curves, and no process left behind."""

import os
import pickle
import signal
import subprocess
import sys
import time
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace

import pytest
from command_lines import failed, refused
from ray_processes import assert_gone, ray_processes
from runs import Log, log_of

from headway.config.experiment import BackendConfig
from headway.events import CheckpointSaved, Failed, Finished, IterationFinished, Started, Usage
from headway.store.checkpoint import latest_iteration
from headway.store.index import RunIndex, RunRow
from headway.store.run_folder import CHECKPOINTS
from headway_launch.commands.main import run
from headway_launch.experiments.compose import compose
from headway_launch.runner.cluster.ray_cluster import SessionCluster
from headway_launch.runner.cores import CoreShares, gpus_of, share_cores, workers_of
from headway_launch.runner.jobs import plan_jobs

needs_ray = pytest.mark.skipif(
    find_spec("ray") is None, reason='Ray is not installed: pip install "headway[ray]"'
)
TINY = (
    "env=visitors", "algo=ippo", "energy=off", "seed=3", "rollout.copies=4", "rollout.block=2",
    "rollout.steps=32", "evaluation.episodes=1", "evaluation.final_episodes=2", "evaluation.rules=[]",
    "store.checkpoint_every=4", "backend.workers=2", "env_steps=10240",
)  # fmt: skip
PATIENCE_S = 180.0


def _started(*words: str, folder: Path) -> "subprocess.Popen[str]":
    command = [sys.executable, "-m", "headway_launch", *words]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    return subprocess.Popen(command, cwd=folder, text=True, start_new_session=True, **pipes)


def _runs(folder: Path) -> dict[int, RunRow]:
    return {row.seed: row for row in RunIndex(folder / "runs").rows()}


def _tables(row: RunRow) -> Log:
    return log_of(row.directory)


def _kept(folder: Path) -> int:
    """Return the iteration of the newest checkpoint of the only run; 0 if there is none."""
    return max((latest_iteration(each) or 0 for each in (folder / "runs").rglob(CHECKPOINTS)), default=0)


def _until_kept(process: "subprocess.Popen[str]", folder: Path, after: int = 0) -> None:
    """Wait for the first checkpoint later than iteration `after`."""
    deadline = time.monotonic() + PATIENCE_S
    while _kept(folder) <= after:
        assert process.poll() is None, process.communicate()[1]
        assert time.monotonic() < deadline
        time.sleep(0.05)


@pytest.fixture(scope="module")
def by_processes(tmp_path_factory: pytest.TempPathFactory) -> Log:
    """Tables of the same training with worker processes."""
    folder = tmp_path_factory.mktemp("process")
    assert run(["run", *TINY, f"store.root={folder / 'runs'}"]) == 0
    return _tables(_runs(folder)[3])


@pytest.mark.cluster
@needs_ray
def test_a_session_killed_resumed_and_stopped_by_ctrl_c_has_the_curves_of_processes(
    tmp_path: Path, by_processes: Log
) -> None:
    """Ctrl-C at a terminal reaches the whole process group, including Ray's processes."""
    before = ray_processes()
    with _started("run", *TINY, "backend=ray", folder=tmp_path) as process:
        _until_kept(process, tmp_path)
        process.kill()
        process.communicate(timeout=PATIENCE_S)
    killed_at, [row] = _kept(tmp_path), _runs(tmp_path).values()
    with _started("resume", row.run_id, folder=tmp_path) as process:
        _until_kept(process, tmp_path, after=killed_at)
        os.killpg(process.pid, signal.SIGINT)
        _, shown = process.communicate(timeout=PATIENCE_S)
        assert process.returncode == 130, shown
    assert "with a checkpoint" in shown
    assert "failed" not in shown
    assert "(raylet)" not in shown
    [row] = _runs(tmp_path).values()
    assert row.status == "KILLED"
    assert killed_at < row.iterations == _kept(tmp_path) < 80
    here, whole = _tables(row), by_processes
    assert all(rows and rows == whole[table][: len(rows)] for table, rows in here.items())
    assert_gone(before)


@pytest.mark.cluster
@needs_ray
def test_runs_queue_on_the_cluster_and_a_lost_one_continues(tmp_path: Path, by_processes: Log) -> None:
    before = ray_processes()
    words = ("algo=ippo,ia2c", "backend=ray", "backend.learners=cluster", "backend.parallel=1")
    with _started(
        "sweep", *(word for word in TINY if word != "algo=ippo"), *words, folder=tmp_path
    ) as process:
        _until_kept(process, tmp_path)
        [host] = [host for host in ray_processes() - before if "TrainingHost" in " ".join(host.cmdline())]
        children = host.children(recursive=True)
        host.kill()
        _, shown = process.communicate(timeout=2 * PATIENCE_S)
        assert process.returncode == 0, shown
    lost = "its training process was lost (its worker process has died); restarted from its last checkpoint"
    assert shown.count(lost) == 1
    assert not any(child.is_running() for child in children)
    ended = {row.algorithm: row for row in RunIndex(tmp_path / "runs").rows()}
    assert {name: row.status for name, row in ended.items()} == {"ippo": "FINISHED", "ia2c": "FINISHED"}
    assert _tables(ended["ippo"]) == by_processes
    assert_gone(before)


@pytest.mark.skipif(find_spec("ray") is not None, reason="Ray is installed")
def test_without_ray_nothing_starts(empty_folder: Path) -> None:
    line = 'headway: backend=ray needs Ray, which is an extra: pip install "headway[ray]"\n'
    assert refused("run", *TINY, "backend=ray") == line
    assert not list(empty_folder.iterdir())


@pytest.mark.cluster
@needs_ray
@pytest.mark.parametrize("words", [("run",), ("sweep",)])
def test_an_address_without_a_cluster_starts_nothing(
    words: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    words = (*words, *TINY, "evaluation.every=4096", "backend=ray", "backend.address=127.0.0.1:1")
    cause = "no Ray cluster answers at backend.address=127.0.0.1:1 (Connection refused)"
    assert failed(*words).splitlines()[-1].startswith(f"headway: {cause}")
    assert not list(tmp_path.iterdir())


def test_an_invalid_address_prints_one_line() -> None:
    line = refused("run", *TINY, "backend=ray", "backend.address=nonsense")
    assert line == "headway: backend.address must be auto, local or HOST:PORT, not 'nonsense'\n"


def test_a_session_without_ray_has_no_cluster() -> None:
    cluster = SessionCluster.open([BackendConfig("process"), BackendConfig("serial")])
    assert cluster == SessionCluster()
    assert cluster.backend(BackendConfig("ray")) == BackendConfig("ray")
    cluster.close()


@pytest.mark.parametrize(
    ("cluster", "requested", "given"),
    [
        (SessionCluster("head:1", shared_out=True), {}, ("head:1", 0.0)),
        (SessionCluster("head:1", shared_out=True), {"worker_cpus": 2.0}, ("head:1", 2.0)),
        (SessionCluster("head:1", cpus=64), {"address": "auto"}, ("head:1", None)),
    ],
)
def test_training_processes_are_given_the_cluster_of_the_session(
    cluster: SessionCluster, requested: dict[str, float | str], given: tuple[str, float | None]
) -> None:
    backend = cluster.backend(BackendConfig("ray", **requested))
    assert (backend.address, backend.worker_cpus) == given


@pytest.mark.parametrize(
    ("jobs", "cores", "cpus", "expected"),
    [
        (1, 2, 64, CoreShares(1, 64)),
        (50, 4, 64, CoreShares(4, 16)),
        (50, 16, 8, CoreShares(8, 1)),
        (3, 2, None, CoreShares(2, 1)),
    ],
)
def test_workers_on_a_cluster_share_its_cpus_and_training_processes_the_cores_here(
    jobs: int, cores: int, cpus: int | None, expected: CoreShares
) -> None:
    planned = plan_jobs(compose(["env=trivial", "algo=ippo", f"seed=0..{jobs - 1}", "backend=ray"]))
    assert share_cores(BackendConfig("ray"), planned, cores, cpus) == expected
    whole = SessionCluster("head:1", cpus=64, node_cpus=8, learners=True)
    assert whole.share_cores(BackendConfig("ray"), planned, cores) == CoreShares(jobs, min(64 // jobs, 8))


@needs_ray
@pytest.mark.parametrize(
    ("words", "workers", "node_cpus", "requested", "parallel"),
    [
        (("backend.stack=5", "env.max_copies_per_process=1"), 10, 4, 2, 2),
        (("backend.stack=5", "env.max_copies_per_process=1"), 10, 1, 1, 2),
        (("backend.workers=6", "rollout.copies=6", "rollout.block=1"), 6, 8, 6, 1),
        (("backend.stack=5", "env.max_copies_per_process=1"), 10, None, 0, 2),
    ],
)
def test_a_run_placed_on_the_cluster_requests_at_most_the_cpus_of_a_node(
    words: tuple[str, ...], workers: int, node_cpus: int | None, requested: int, parallel: int
) -> None:
    from headway_launch.runner.cluster.ray_training import cpus_for

    bare = ["env=mpe2.simple_spread_v3", "algo=ippo", "seed=0..9", "backend=ray"]
    composed = compose([*bare, "rollout.copies=2", "rollout.block=2", *words])
    jobs = plan_jobs(composed)
    cpus = None if node_cpus is None else 8
    cluster = SessionCluster("head:1", node_cpus is None, cpus, node_cpus, learners=True)
    shares = cluster.share_cores(composed.config.backend, jobs, cores=4)
    job = replace(jobs[0].training, workers=workers_of(jobs[0], shares))
    assert job.workers == workers
    assert cpus_for(job, node_cpus) == requested
    assert shares.parallel == parallel


@pytest.mark.parametrize(
    ("device", "available", "requested"),
    [("cpu", 4, 0), ("auto", 0, 0), ("auto", 4, 1), ("cuda", 4, 1), ("cuda:1", 0, 1)],
)
def test_a_learner_requests_the_gpu_it_trains_on(device: str, available: float, requested: float) -> None:
    assert gpus_of(device, available) == requested


@needs_ray
def test_resource_use_on_another_machine_is_not_counted_here() -> None:
    from headway_launch.runner.cluster.ray_training import without_usage

    used = Usage(3.0, 5)
    assert without_usage(Started(2, (7, 8))) == Started(2, ())
    times = 9.0, 4.0, 5.0
    assert without_usage(IterationFinished(1, 2, used, *times)) == IterationFinished(1, 2, Usage(), *times)
    assert without_usage(Finished(1, False, used, 2.0)) == Finished(1, False, Usage(), 2.0)
    assert without_usage(CheckpointSaved(4)) == CheckpointSaved(4)


@needs_ray
def test_a_node_without_the_store_prints_one_line(tmp_path: Path) -> None:
    from headway_launch.runner.cluster.ray_training import TrainingHost

    host = TrainingHost()
    host.train(pickle.dumps(SimpleNamespace(directories=(str(tmp_path), "/nowhere/run"))))
    failed, end = host.next_events()
    assert end is None
    assert isinstance(failed, Failed)
    assert "has no folder /nowhere/run: a sweep over a cluster needs store.root on a file" in failed.line
