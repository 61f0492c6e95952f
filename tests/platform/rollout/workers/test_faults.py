"""Workers that die or raise are replaced without a change to the data; NaN is reported in one line."""

import time
from dataclasses import replace
from multiprocessing.popen_forkserver import Popen
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest
from rehearsal import (
    Arrays,
    Fault,
    FaultConfig,
    FaultyVisitors,
    Taken,
    Unloadable,
    assert_same,
    collector_of,
    iterations_of,
    parameters_of,
    plan_of,
)

from headway.contracts import HeadwayError
from headway.rollout.collector import Collector
from headway.rollout.plan import RolloutPlan
from headway.rollout.pool_collector import PoolCollector
from headway.rollout.workers import process_workers
from headway.rollout.workers.worker_pool import WorkerFailedError

SHARD = 2
"""Copies of each of two workers."""


def _plan(folder: Path, fault: Fault = "kill", **choices: Any) -> RolloutPlan:  # noqa: ANN401 - FaultConfig's
    config = FaultConfig(fault, str(folder), **{"at": 30, "copies": SHARD, **choices})
    return plan_of(FaultyVisitors, config)


def _taken(
    plan: RolloutPlan,
    notices: list[str] | None = None,
    iterations: int = 3,
    worker_timeout_s: float | None = None,
) -> list[Taken]:
    notify = notices.append if notices is not None else print
    with collector_of(plan, workers=2, notify=notify, worker_timeout_s=worker_timeout_s) as collector:
        collector.begin()
        return iterations_of(collector, parameters_of(plan), 1, iterations)


@pytest.fixture(scope="module")
def never(tmp_path_factory: pytest.TempPathFactory) -> RolloutPlan:
    """A plan whose workers do not fail."""
    return _plan(tmp_path_factory.mktemp("never"), times=0)


@pytest.fixture(scope="module")
def undisturbed(never: RolloutPlan) -> list[Taken]:
    """Three iterations of workers that do not fail."""
    return _taken(never)


def _one_line(error: BaseException) -> str:
    assert "\n" not in str(error)
    return str(error)


def _kill(process_id: int) -> None:
    process = psutil.Process(process_id)
    process.kill()
    process.wait(10)


@pytest.mark.parametrize(
    ("fault", "reason"),
    [
        ("kill", "killed by signal 9"),
        ("raise", "RuntimeError: the bridge is out"),
        ("exit", "SystemExit: 3"),
        ("hang up", "alive, but it closed its pipe"),
    ],
)
def test_a_worker_that_fails_in_mid_iteration_does_not_change_the_data(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, undisturbed: list[Taken], fault: Fault, reason: str
) -> None:
    monkeypatch.setattr(process_workers, "GRACE_S", 0.5)
    assert_same(undisturbed, _taken(_plan(tmp_path, fault), notices := []))
    assert len(notices) == 1
    assert reason in notices[0]
    assert "from the last snapshot" in notices[0]


@pytest.mark.slow
@pytest.mark.parametrize("fault", ["hang", "stop"])
def test_a_worker_that_hangs_in_mid_iteration_does_not_change_the_data(
    tmp_path: Path, undisturbed: list[Taken], fault: Fault
) -> None:
    """Either `step` does not return, or the process is suspended."""
    assert_same(undisturbed, _taken(_plan(tmp_path, fault), notices := [], worker_timeout_s=5.0))
    [notice] = notices
    assert "failed (no answer for 5 s while stepping faulty in iteration 2; if it is only slow" in notice
    assert "set a higher backend.worker_timeout_s); replaced, repeating" in notice


@pytest.mark.slow
def test_a_worker_that_hangs_twice_ends_the_run_in_one_line(tmp_path: Path) -> None:
    with pytest.raises(
        WorkerFailedError, match=r"failed twice \(no answer for 4 s while stepping faulty"
    ) as it:
        _taken(_plan(tmp_path, "hang", times=9), [], worker_timeout_s=2.0)
    _one_line(it.value)


@pytest.mark.parametrize("fault", ["fork", "fork in reset", "fork and raise"])
def test_an_environment_that_forks_does_not_change_the_data(
    tmp_path: Path, undisturbed: list[Taken], fault: Fault
) -> None:
    """The forked process would answer too, so that every later answer would be that to the command before."""
    assert_same(undisturbed, _taken(_plan(tmp_path, fault), notices := []))
    assert notices == []


def test_two_workers_killed_in_one_iteration_are_replaced(tmp_path: Path, undisturbed: list[Taken]) -> None:
    # Both faults strike at the same step; a replacement finds both marks and does not strike again.
    assert_same(undisturbed, _taken(_plan(tmp_path, times=2, at=21), notices := []))
    assert 1 <= len(notices) <= 2


@pytest.mark.parametrize("snapshots", [True, False])
def test_a_killed_worker_of_one_replica_of_a_stack_is_replaced(tmp_path: Path, snapshots: bool) -> None:
    """Two seeds of two copies, one process per copy: the other processes are not affected."""

    def taken(times: int, notices: list[str]) -> list[Taken]:
        config = FaultConfig("kill", str(tmp_path), 30, 1, times, snapshots, limit=1)
        plan = plan_of(FaultyVisitors, config, seeds=(5, 6), copies=2)
        with collector_of(plan, workers=4, notify=notices.append) as collector:
            collector.begin()
            return iterations_of(collector, parameters_of(plan), 1, 3)

    notices: list[str] = []
    undisturbed, disturbed = taken(0, []), taken(1, notices)
    assert len(notices) == 1
    assert ("from the last snapshot" if snapshots else "its episodes start again") in notices[0]
    if snapshots:
        assert_same(undisturbed, disturbed)
    seen = undisturbed[1].arrays["observations"], disturbed[1].arrays["observations"]
    changed = [not np.array_equal(seen[0][:, c], seen[1][:, c], equal_nan=True) for c in range(4)]
    assert sum(changed) == (not snapshots)


def _evaluate(collector: Collector, parameters: Arrays) -> Any:  # noqa: ANN401 - rows, compared only
    return collector.evaluate(7, 23, False, parameters)


def test_workers_killed_between_commands_are_replaced(never: RolloutPlan, undisturbed: list[Taken]) -> None:
    parameters, notices = parameters_of(never), list[str]()
    with collector_of(never, workers=2, notify=notices.append) as collector:
        _kill(collector.process_ids()[0])
        collector.begin()
        expected = _evaluate(collector, parameters)
        _kill(collector.process_ids()[1])
        collected = iterations_of(collector, parameters, 1, 1)
        for process_id in collector.process_ids():
            _kill(process_id)
        assert _evaluate(collector, parameters) == expected
        collected += iterations_of(collector, parameters, 2, 2)
        _kill(collector.process_ids()[0])
        snapshots = collector.snapshot()
        collected += iterations_of(collector, parameters, 3, 3)
        assert_same(undisturbed, collected)
    assert len(notices) == 5
    with collector_of(never, workers=2, notify=notices.append) as collector:
        _kill(collector.process_ids()[0])
        collector.restore(snapshots, 2)
        assert_same(undisturbed[2:], iterations_of(collector, parameters, 3, 3))
    assert "start again" not in notices[-1]


def test_a_worker_killed_in_evaluation_keeps_its_state(tmp_path: Path, undisturbed: list[Taken]) -> None:
    plan, notices = _plan(tmp_path, at=3, copies=10), list[str]()
    parameters = parameters_of(plan)
    with collector_of(plan, workers=2, notify=notices.append) as collector:
        collector.begin()
        collected = iterations_of(collector, parameters, 1, 1)
        _evaluate(collector, parameters)
        assert len(notices) == 1
        assert all(snapshot is not None for snapshot in collector.snapshot())
        for process_id in collector.process_ids():
            _kill(process_id)
        collected += iterations_of(collector, parameters, 2, 3)
    assert_same(undisturbed, collected)


def test_killed_twice_in_a_row_ends_the_run_in_one_line(tmp_path: Path) -> None:
    plan = _plan(tmp_path, times=9)
    with collector_of(plan, workers=2) as collector:
        collector.begin()
        processes = [psutil.Process(process_id) for process_id in collector.process_ids()]
        with pytest.raises(WorkerFailedError, match=r"failed twice.*killed by signal 9") as failure:
            iterations_of(collector, parameters_of(plan), 1, 3)
        _one_line(failure.value)
        ids = [process.pid for process in processes] + collector.process_ids()
    assert not any(psutil.pid_exists(process_id) for process_id in ids)


@pytest.mark.parametrize("fault", ["raise", "bad snapshot"])
def test_a_second_failure_ends_the_run_with_the_worker_s_traceback(tmp_path: Path, fault: Fault) -> None:
    with pytest.raises(WorkerFailedError) as failure:
        _taken(_plan(tmp_path, fault, times=9))
    cause = {
        "raise": "RuntimeError: the bridge is out",
        "bad snapshot": "FaultyVisitors.snapshot.<locals>.<lambda>",
    }[fault]
    assert cause in _one_line(failure.value)
    assert "Traceback (most recent call last)" in failure.value.details
    assert {"raise": "in _fail", "bad snapshot": "dumps"}[fault] in failure.value.details


@pytest.mark.parametrize("failures", [2, 10_000])
def test_a_worker_starts_although_its_fork_server_ends(
    monkeypatch: pytest.MonkeyPatch, never: RolloutPlan, undisturbed: list[Taken], failures: int
) -> None:
    launch, left = Popen._launch, [EOFError(), ConnectionRefusedError()] * (failures // 2)

    def launch_if_alive(popen: Popen, process: Any) -> None:  # noqa: ANN401 - multiprocessing's
        if left:
            raise left.pop()
        launch(popen, process)

    monkeypatch.setattr(Popen, "_launch", launch_if_alive)
    if failures == 2:
        assert_same(undisturbed, _taken(never))
    else:
        with pytest.raises(
            HeadwayError, match="the fork server, which starts worker processes, keeps ending"
        ):
            _taken(never)


def test_a_plan_that_a_worker_cannot_load_is_reported_with_its_traceback(never: RolloutPlan) -> None:
    plan = replace(never, make_env=Unloadable())
    with collector_of(plan) as collector, pytest.raises(WorkerFailedError) as failure:
        collector.begin()
    assert "ModuleNotFoundError: No module named 'nowhere'" in _one_line(failure.value)
    assert "pickle.loads" in failure.value.details


@pytest.mark.parametrize(
    ("fault", "name"),
    [
        ("nan observation", "serial"),
        ("nan reward", "process"),
        ("nan state", "process"),
        ("nan final", "serial"),
    ],
)
def test_nan_is_reported_with_copy_agent_and_step(tmp_path: Path, fault: Fault, name: str) -> None:
    plan = _plan(tmp_path, fault, at=13, times=1, copies={"serial": 4, "process": SHARD}[name])
    with collector_of(plan, name, workers=2) as collector:
        collector.begin()
        with pytest.raises(HeadwayError, match=r"environment faulty returned (nan|inf)") as failure:
            collector.collect(1, parameters_of(plan))
    line = _one_line(failure.value)
    assert not isinstance(failure.value, WorkerFailedError)
    assert "at step 13" in line
    assert "copy 1 " in line or (name == "process" and "copy 3 " in line)
    assert fault == "nan state" or "visitor_2" in line


def test_nan_in_a_stack_is_reported_with_its_seed(tmp_path: Path) -> None:
    config = FaultConfig("nan reward", str(tmp_path), at=3, copies=4)
    plan = plan_of(FaultyVisitors, config, seeds=(5, 6, 7, 8), copies=1)  # row 1 is seed 6's only copy
    with collector_of(plan, "serial") as collector:
        collector.begin()
        with pytest.raises(HeadwayError, match=r"copy 0 of seed 6\b"):
            collector.collect(1, parameters_of(plan))


@pytest.mark.parametrize("name", ["serial", "process"])
def test_nan_in_evaluation_is_reported_too(tmp_path: Path, name: str) -> None:
    plan = _plan(tmp_path, "nan reward", at=2, copies=10)
    with collector_of(plan, name) as collector, pytest.raises(HeadwayError, match="returned inf as reward"):
        collector.evaluate(7, 10, True, parameters_of(plan))


def test_absent_agents_may_hold_nan(undisturbed: list[Taken]) -> None:
    assert any(np.isnan(part.arrays["observations"]).any() for part in undisturbed)


@pytest.mark.slow
def test_closing_does_not_wait_for_busy_workers(never: RolloutPlan, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(process_workers, "GRACE_S", 2.0)
    with collector_of(never, workers=2) as collector:
        assert isinstance(collector, PoolCollector)
        collector.begin()
        children = [psutil.Process(process_id) for process_id in collector.process_ids()]
        for process in children:
            process.suspend()  # simulates an endless step
        began = time.monotonic()
    assert time.monotonic() - began < 3.9  # one grace period for all workers, not one per worker
    assert not any(process.is_running() for process in children)


def test_cpu_seconds_of_replaced_workers_still_count(never: RolloutPlan) -> None:
    parameters = parameters_of(never)
    with collector_of(never, workers=2) as collector:
        collector.begin()
        assert collector.collect(1, parameters)
        before = collector.usage()
        assert before.cpu_seconds > 0
        assert before.memory_bytes > 1_000_000
        for process_id in collector.process_ids():
            _kill(process_id)
        collector.collect(2, parameters)
        assert collector.usage().cpu_seconds > before.cpu_seconds
