"""Asynchronous training: reproducible with a fixed order of workers, and complete in order of arrival."""

import multiprocessing
import pickle
import time
from collections.abc import Iterator, Mapping
from contextlib import closing, contextmanager
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import psutil
import pytest
from numpy.typing import NDArray
from rehearsal import (
    TOYS,
    VISITORS,
    Fault,
    FaultConfig,
    FaultyVisitors,
    RareVisitors,
    Showing,
    TediousVisitors,
    parameters_of,
    plan_of_toy,
)
from runs import COPIES, GRU, STEPS, Backend, Log, job_of, logs_of, trained, with_algorithm

from headway.config.experiment import BackendConfig
from headway.contracts import Contribution, Contributor, HeadwayError, Trajectory
from headway.events import Event, Notice, Started, Usage
from headway.rollout.async_collector import PoolContributors, SerialContributors
from headway.rollout.backends import open_contributors
from headway.rollout.collector import Contributors
from headway.rollout.serial_collector import SerialCollector
from headway.rollout.workers.process_workers import GRACE_S, ProcessLauncher, SamplingProcessLauncher
from headway.rollout.workers.shared_memory import Content, SharedBlock
from headway.rollout.workers.worker import Contribute, Done
from headway.rollout.workers.worker_pool import WorkerFailedError
from headway.training.loop import TrainingJob, train
from headway.training.modes import AsynchronousMode
from headway_algos.config import ModelConfig
from headway_algos.registry import ENTRIES

Core = Literal["none", "gru"]
MEBIBYTE = 2**20


def _job(
    algorithm: str,
    folder: Path,
    application: str = "in_turns",
    core: Core = "none",
    **choices: Any,  # noqa: ANN401 - those of `job_of`
) -> TrainingJob:
    """A job of `job_of`, but of any algorithm; a3c has one worker per block of its four copies."""
    entry, model = ENTRIES[algorithm], ModelConfig((8,), core=core, **(GRU if core == "gru" else {}))
    more: dict[str, Any] = {"application": application} if algorithm == "a3c" else {}
    return with_algorithm(job_of(folder, **choices), entry, entry.config(model=model, **more))


def _showing(job: TrainingJob) -> TrainingJob:
    """The job with workers that contribute their trajectories."""
    return replace(job, plan=replace(job.plan, make_contributor=Showing))


def _log(job: TrainingJob) -> Log:
    trained(job)
    return logs_of(job)[0]


def _notices(events: list[Event]) -> list[str]:
    return [event.line for event in events if isinstance(event, Notice)]


def _without_staleness(log: Log) -> Log:
    curve = [{k: v for k, v in row.items() if not k.startswith("staleness/")} for row in log["curve"]]
    return {**log, "curve": curve}


def _staleness(log: Log) -> list[tuple[float, float]]:
    """(mean, max) staleness per iteration."""
    rows = log["curve"][1:]
    return [(float.fromhex(row["staleness/mean"]), float.fromhex(row["staleness/max"])) for row in rows]


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Log:
    """Six iterations of two workers in turns on visitors, undisturbed, on the serial backend."""
    return _log(_job("a3c", tmp_path_factory.mktemp("whole")))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("toy", "core", "backend"),
    [("visitors", "none", "process"), ("visitors", "gru", "serial"), ("tracking", "none", "serial")],
)
def test_a_single_worker_equals_synchronous_a2c_on_the_same_batches(
    tmp_path: Path, toy: str, core: Core, backend: Backend
) -> None:
    """Parameters, normalisers, metrics and evaluations agree to the last bit."""
    choices: dict[str, Any] = {"env": TOYS[toy], "core": core, "block": COPIES}
    synchronous = _log(_job("ia2c", tmp_path / "ia2c", **choices))
    alone = _log(_job("a3c", tmp_path / "a3c", backend=backend, **choices))
    assert _without_staleness(alone) == synchronous
    assert _staleness(alone) == [(0.0, 0.0)] * 6


def test_the_staleness_of_workers_in_turns_is_the_number_of_other_workers(whole: Log, tmp_path: Path) -> None:
    assert _staleness(whole) == [(0.5, 1.0)] + [(1.0, 1.0)] * 5
    four = _log(_job("a3c", tmp_path / "four", block=1))
    assert _staleness(four) == [(1.5, 3.0)] + [(3.0, 3.0)] * 5
    assert _without_staleness(four) != _without_staleness(whole)


@pytest.mark.slow
@pytest.mark.parametrize(("core", "stop"), [("none", 1), ("gru", 4)])
def test_resumed_equals_never_stopped(tmp_path: Path, core: Core, stop: int) -> None:
    """Including the rollouts in progress, their old parameters, and the critics' hidden states."""
    undisturbed = _log(_job("a3c", tmp_path / "whole", core=core))
    trained(job := _job("a3c", tmp_path / "stopped", core=core), stop_after=stop)
    assert _notices(trained(replace(job, resume=True))) == []
    assert logs_of(job) == [undisturbed]


@pytest.mark.slow
def test_the_process_backend_resumes_a_checkpoint_of_the_serial_backend(whole: Log, tmp_path: Path) -> None:
    trained(_job("a3c", tmp_path), stop_after=3)
    assert _log(_job("a3c", tmp_path, backend="process", resume=True)) == whole


def test_without_snapshots_a_resumed_run_notifies_and_continues(tmp_path: Path) -> None:
    faulty = FaultyVisitors, FaultConfig("kill", str(tmp_path), at=1, copies=2, times=0, snapshots=False)
    trained(job := _job("a3c", tmp_path, env=faulty), stop_after=2)
    events = trained(replace(job, resume=True))
    assert "episodes restart after" in _notices(events)[0]
    started = [event for event in events if isinstance(event, Started)]
    assert started[0].episodes_restarted
    assert _staleness(logs_of(job)[0])[2:] == [(0.5, 1.0)] + [(1.0, 1.0)] * 3  # all start with one version


def _faulty(folder: Path, fault: Fault, times: int = 1) -> tuple[type[FaultyVisitors], FaultConfig]:
    return FaultyVisitors, FaultConfig(fault, str(folder), at=41, copies=2, times=times)


@pytest.mark.slow
def test_a_worker_killed_in_mid_rollout_does_not_change_the_curve(whole: Log, tmp_path: Path) -> None:
    job = _job("a3c", tmp_path, env=_faulty(tmp_path, "kill"), backend="process")
    (notice,) = _notices(trained(job))
    assert "killed by signal 9" in notice
    assert "replaced, repeating its part from the last snapshot" in notice
    assert logs_of(job) == [whole]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("fault", "kind", "line"),
    [
        ("nan reward", HeadwayError, r"returned inf as reward of agent visitor_2 in copy [13]"),
        ("kill", WorkerFailedError, r"worker [01] failed twice \(killed by signal 9\)"),
    ],
)
def test_a_run_that_cannot_continue_ends_in_one_line_and_leaves_no_worker(
    tmp_path: Path, fault: Fault, kind: type[HeadwayError], line: str
) -> None:
    events: list[Event] = []
    env = _faulty(tmp_path, fault, times=9)
    with pytest.raises(kind, match=line) as failure:
        train(_job("a3c", tmp_path, "arrival", env=env, backend="process"), events.append, lambda: False)
    assert "\n" not in str(failure.value)
    (started,) = [event for event in events if isinstance(event, Started)]
    assert not any(psutil.pid_exists(process_id) for process_id in started.process_ids[1:])


@pytest.mark.slow
def test_a_resumed_run_in_order_of_arrival_notifies_that_its_curve_differs(tmp_path: Path) -> None:
    job = _job("a3c", tmp_path, "arrival", backend="process")
    trained(job, stop_after=3)
    (notice,) = _notices(trained(replace(job, resume=True)))
    assert "after iteration 3 its curve differs from that of an uninterrupted run" in notice
    (log,) = logs_of(job)
    assert [row["env_steps"] for row in log["curve"]] == [str(i * COPIES * STEPS) for i in range(7)]


@pytest.mark.slow
def test_a_process_holds_no_more_copies_than_allowed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rare = RareVisitors, VISITORS
    assert len(_log(_job("a3c", tmp_path, env=rare, backend="process", iterations=1))["curve"]) == 2
    with pytest.raises(HeadwayError, match=r"set backend=process, rollout\.block=2 and backend\.workers=2$"):
        trained(_job("a3c", tmp_path / "serial", env=rare))
    monkeypatch.setattr(RareVisitors, "held", 0)
    with pytest.raises(HeadwayError, match=r"hold more; set rollout\.block=2 and backend\.workers=2$"):
        trained(_job("a3c", tmp_path / "large", env=rare, backend="process", block=4))


def test_a_checkpoint_of_other_workers_is_refused_with_the_block_to_set(tmp_path: Path) -> None:
    trained(_job("a3c", tmp_path), stop_after=1)
    for backend in ("serial", "process"):
        with pytest.raises(HeadwayError, match=r"with 2 workers, not with 4, .* plan\.json to 2$") as refusal:
            trained(_job("a3c", tmp_path, block=1, backend=backend, resume=True))
        assert "backend.name" not in str(refusal.value)


def test_a_contributor_with_a_synchronous_learner_is_refused_by_the_name_of_its_entry(tmp_path: Path) -> None:
    job = _job("a3c", tmp_path)
    config = replace(job.config, algo={"name": "theirs"})
    with pytest.raises(HeadwayError, match="algo=theirs has a contributor, but its learner is not a"):
        trained(replace(job, config=config, make_learner=ENTRIES["ippo"].learner))


@contextmanager
def _opened(job: TrainingJob, notices: list[str]) -> Iterator[PoolContributors]:
    with closing(open_contributors(BackendConfig("process"), job.plan, notices.append)) as contributors:
        assert isinstance(contributors, PoolContributors)
        contributors.begin()
        yield contributors


def test_contributors_share_neither_a_trajectory_nor_parameters(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each has a trajectory of its own copies, and parameters come with its tasks."""
    created: list[str] = []
    create = SharedBlock.create

    def noted(nbytes: int, content: Content = "trajectories") -> SharedBlock:
        created.append(content)
        return create(nbytes, content)

    monkeypatch.setattr(SharedBlock, "create", noted)
    plan = replace(plan_of_toy("visitors", copies=4, block=2), make_contributor=Showing)
    ProcessLauncher(plan, plan.block_shards)
    assert created == ["the environment"]
    SamplingProcessLauncher(plan.evaluation_plan, [plan.evaluation_plan.whole])
    assert created[1:] == ["trajectories", "parameters", "the environment"]


def test_no_process_is_left_if_contributors_cannot_start(tmp_path: Path) -> None:
    def unpicklable() -> Contributor:
        raise AssertionError("no worker is started")

    plan = replace(_job("a3c", tmp_path).plan, make_contributor=unpicklable)
    before = set(multiprocessing.active_children())
    with pytest.raises((pickle.PicklingError, AttributeError), match="unpicklable"):
        open_contributors(BackendConfig("process"), plan, print)
    assert set(multiprocessing.active_children()) == before


def test_workers_sample_the_same_as_the_serial_collector_on_their_copies(tmp_path: Path) -> None:
    plan = _job("a3c", tmp_path).plan
    acting = parameters_of(plan)
    together = SerialCollector(plan)
    together.begin()
    together.collect(1, acting)
    contributors = SerialContributors(replace(plan, make_contributor=Showing))
    contributors.begin()
    for worker in range(2):
        contributors.assign(worker, Contribute(1, 0, acting))
        done = contributors.next_done(worker)[2].contribution
        assert done is not None
        for each in fields(Trajectory):
            whole = getattr(together.trajectory, each.name)
            if not each.name.startswith("final"):  # valid in few rows
                np.testing.assert_array_equal(done.arrays[each.name], whole[:, 2 * worker : 2 * worker + 2])
            # A view of a larger trajectory would have gaps.
            assert getattr(contributors.workers[worker].trajectory, each.name).flags.c_contiguous


@pytest.mark.slow
def test_workers_stay_small(tmp_path: Path) -> None:
    job = _job("a3c", tmp_path, "arrival")
    learner: Any = job.make_learner(job.algo_config, job.spec, job.seeds, "cpu")
    with _opened(job, []) as contributors:
        mode = AsynchronousMode(learner, contributors, iterations=1000)
        for iteration in range(1, 20):
            mode.iterate(iteration, 0.0)
        processes = [psutil.Process(process_id) for process_id in contributors.pool.process_ids()]
        sizes = [process.memory_info().rss for process in processes]
        threads = [process.num_threads() for process in processes]
    assert max(sizes) < 450 * MEBIBYTE
    assert max(threads) <= 3  # the worker's own, and the one that ends it with its parent


@pytest.mark.slow
def test_usage_includes_rollouts_in_progress_and_closing_does_not_wait_for_them(tmp_path: Path) -> None:
    """A complete rollout takes 8 CPU seconds."""
    job = _job("a3c", tmp_path, "arrival", env=(TediousVisitors, VISITORS))
    learner: Any = job.make_learner(job.algo_config, job.spec, job.seeds, "cpu")
    with _opened(job, []) as contributors:
        processes = [psutil.Process(process_id) for process_id in contributors.pool.process_ids()]
        idle = contributors.usage().cpu_seconds
        for worker in range(2):
            contributors.assign(worker, Contribute(worker + 1, 0, learner.published()))
        began = [process.cpu_times().user for process in processes]
        while min(p.cpu_times().user - b for p, b in zip(processes, began, strict=True)) < 0.3:
            time.sleep(0.02)
        used = contributors.usage().cpu_seconds
        assert used >= idle + 0.6
        assert contributors.usage().cpu_seconds >= used
        closing_began = time.monotonic()
    assert time.monotonic() - closing_began < GRACE_S / 2
    assert not any(psutil.pid_exists(process.pid) for process in processes)


def test_other_workers_continue_while_the_rollout_of_a_dead_worker_is_repeated(tmp_path: Path) -> None:
    """A checkpoint written meanwhile holds the state before the rollout."""
    job = _showing(_job("a3c", tmp_path, "arrival"))
    acting = job.make_learner(job.algo_config, job.spec, job.seeds, "cpu").acting_parameters()
    with _opened(job, []) as contributors:
        before = contributors.pool.workers[0].snapshot
        killed = psutil.Process(contributors.pool.process_ids()[0])
        killed.suspend()
        contributors.assign(0, Contribute(1, 0, acting))
        killed.kill()
        while contributors.pool.process_ids()[0] == killed.pid:
            contributors.pool.receive(0)
        replacement = psutil.Process(contributors.pool.process_ids()[0])
        replacement.suspend()
        for number in (2, 3, 4):
            contributors.assign(1, Contribute(number, 0, acting))
            assert contributors.next_done(None)[0] == 1
        assert contributors.snapshot()[0]["worker"] is before
        replacement.resume()
        worker, task, _ = contributors.next_done(None)
        assert (worker, task.number) == (0, 1)
        assert not contributors.tasks


def test_restarted_episodes_differ_after_every_death_of_a_worker(tmp_path: Path) -> None:
    faulty = FaultyVisitors, FaultConfig("kill", str(tmp_path), at=1, copies=2, times=0, snapshots=False)
    job = _showing(_job("a3c", tmp_path, "arrival", env=faulty))
    acting = job.make_learner(job.algo_config, job.spec, job.seeds, "cpu").acting_parameters()
    faced = []
    with _opened(job, notices := []) as contributors:
        for number in (1, 2, 3):
            process = psutil.Process(contributors.pool.process_ids()[0])
            process.suspend()
            contributors.assign(0, Contribute(number, 0, acting))
            process.kill()
            _, _, done = contributors.next_done(None)
            assert done.contribution is not None
            faced.append(done.contribution.arrays["observations"][0])
            assert done.contribution.arrays["number"] == number
    assert len(notices) == 3
    assert all("its episodes start again" in notice for notice in notices)
    assert len({first.tobytes() for first in faced}) == 3


def test_contributions_are_each_applied_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two per iteration in order of arrival, although a worker hangs for a while, then dies with one."""
    job = _showing(_job("a3c", tmp_path, "arrival"))
    acting = job.make_learner(job.algo_config, job.spec, job.seeds, "cpu").acting_parameters()
    learner: Any = _Recorder(in_turns=False, acting=acting)
    results: list[tuple[int, int]] = []
    with _opened(job, notices := []) as contributors:
        receive = contributors.next_done

        def next_done(turn: int | None) -> tuple[int, Contribute, Done]:
            worker, task, done = receive(turn)
            results.append((worker, task.number))
            return worker, task, done

        monkeypatch.setattr(contributors, "next_done", next_done)
        first = psutil.Process(contributors.pool.process_ids()[0])
        mode = AsynchronousMode(learner, contributors, iterations=12)
        mode.iterate(1, 0.0)
        first.suspend()
        for iteration in range(2, 6):
            mode.iterate(iteration, 0.0)
        first.kill()
        for iteration in range(6, 13):
            mode.iterate(iteration, 0.0)
    assert len(notices) == 1
    applied = [int(arrays["number"]) for arrays, _, _ in learner.applied]
    assert applied == [number for _, number in results]
    assert sorted(applied) == list(range(1, 2 * 12 + 1))
    assert {worker for worker, _ in results} == {0, 1}


@dataclass
class _Recorder:
    """A learner stub that records the arguments of `apply`."""

    in_turns: bool
    acting: dict[str, NDArray[Any]] | None = None
    """Parameters to publish; None: the number of updates."""
    applied: list[tuple[Mapping[str, NDArray[Any]], int, float]] = field(default_factory=list)

    def published(self) -> dict[str, NDArray[Any]]:
        return self.acting or {"updates": np.array([len(self.applied)])}

    def apply(self, contribution: Contribution, iteration: int, progress: float) -> None:
        self.applied.append((contribution.arrays, iteration, progress))


@dataclass
class _Scripted:
    """Workers that finish in a given order."""

    order: list[int]
    in_turns: bool = False
    number: int = 3
    tasks: dict[int, Contribute] = field(default_factory=dict)
    numbers: list[int] = field(default_factory=list)

    def idle(self) -> list[int]:
        return [worker for worker in range(self.number) if worker not in self.tasks]

    def assign(self, worker: int, task: Contribute) -> None:
        assert worker not in self.tasks
        self.tasks[worker] = task
        self.numbers.append(task.number)

    def next_done(self, turn: int | None) -> tuple[int, Contribute, Done]:
        worker = self.order.pop(0) if turn is None else turn
        task = self.tasks.pop(worker)
        metrics: Mapping[str, NDArray[np.float64]] = {"policy/entropy": np.array([float(worker)])}
        given = {"of": np.array(f"{worker}@{task.published['updates'][0]}")}
        return worker, task, Done([], [], None, Usage(), Contribution(given, metrics))


def test_staleness_is_the_number_of_updates_since_the_parameters_were_published() -> None:
    learner: Any = _Recorder(in_turns=False)
    scripted: Any = _Scripted([2, 2, 0, 2, 1, 1])
    contributors: Contributors = scripted
    mode = AsynchronousMode(learner, contributors, iterations=1000)
    assert not mode.deterministic
    one, two = mode.iterate(1, 0.0), mode.iterate(2, 0.5)
    applied = [str(arrays["of"]) for arrays, _, _ in learner.applied]
    assert applied == ["2@0", "2@1", "0@0", "2@2", "1@0", "1@5"]
    assert [(i, progress) for _, i, progress in learner.applied] == [(1, 0.0)] * 3 + [(2, 0.5)] * 3
    # Applied as updates 0, 1, 2 and 3, 4, 5: of versions 0, 1, 0 and 2, 0, 5.
    assert [float(one.metrics[f"staleness/{of}"][0]) for of in ("mean", "max")] == [2 / 3, 2.0]
    assert [float(two.metrics[f"staleness/{of}"][0]) for of in ("mean", "max")] == [5 / 3, 4.0]
    assert float(one.metrics["policy/entropy"][0]) == pytest.approx((2 + 2 + 0) / 3)
    assert {worker: task.updates for worker, task in scripted.tasks.items()} == {0: 3, 2: 4, 1: 6}
    assert {worker: task.number for worker, task in scripted.tasks.items()} == {0: 6, 2: 7, 1: 9}


@pytest.mark.parametrize(("in_turns", "order"), [(False, [2, 2, 0, 1, 0, 2]), (True, [])])
def test_no_contribution_beyond_the_budget_is_assigned(in_turns: bool, order: list[int]) -> None:
    learner: Any = _Recorder(in_turns)
    scripted: Any = _Scripted(order)
    mode = AsynchronousMode(learner, scripted, iterations=2)
    mode.iterate(1, 0.0)
    assert len(scripted.tasks) == 3
    mode.iterate(2, 0.5)
    assert not scripted.tasks
    assert len(learner.applied) == 6
    assert scripted.numbers == [1, 2, 3, 4, 5, 6]  # no two draw the same
