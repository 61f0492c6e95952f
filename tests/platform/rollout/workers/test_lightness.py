"""Memory, imports and clean-up of worker processes, measured in separate processes so that neither pytest nor
its plugins are counted."""

import gc
import json
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import psutil
import pytest
from rehearsal import collector_of, parameters_of, plan_of_toy

from headway.rollout.pool_collector import PoolCollector

pytestmark = pytest.mark.slow

SUPPORT = str(Path(__file__).parents[3] / "support")
MEBIBYTE = 2**20
HEAVY = {"torch", "pandas", "pyarrow", "mlflow", "scipy", "pettingzoo", "gymnasium", "matplotlib"}

_MEASURE = """
import json, sys
import psutil
sys.path.insert(0, sys.argv[1])
from rehearsal import collector_of, parameters_of, plan_of
from spying import SpyConfig, make_spy

plan = plan_of(make_spy, SpyConfig(sys.argv[2]), copies=8, steps=512, block=4)
for attempt in ("cold", "warm"):
    with collector_of(plan) as collector:
        collector.begin()
        collector.collect(1, parameters_of(plan))
        own = [psutil.Process(process_id).memory_full_info().uss for process_id in collector.process_ids()]
print(json.dumps(own))
"""

_HEAVY_MAIN = """
import sys
import pandas
sys.path.insert(0, sys.argv[1])
from headway_envs.toy.trivial import Trivial
from rehearsal import collector_of, parameters_of, plan_of
from spying import SpyConfig, make_spy

class Mine(Trivial):
    pass

def make_mine(config, copies):
    make_spy(config, copies)
    return Mine(config.trivial, copies)

make = {"the library's": make_spy, "its own": make_mine}[sys.argv[3]]
plan = plan_of(make, SpyConfig(sys.argv[2]))
guard = __name__ == "__main__" or sys.argv[3] == "the library's"
if guard:
    with collector_of(plan) as collector:
        collector.begin()
        collector.collect(1, parameters_of(plan))
"""

_COLLECT_FOR_EVER = """
import sys, time
sys.path.insert(0, sys.argv[1])
from rehearsal import parameters_of, plan_of_toy
from headway.rollout.pool_collector import PoolCollector
from headway.rollout.workers.process_workers import SamplingProcessLauncher

plan = plan_of_toy("visitors", copies=8, steps=500)
collector = PoolCollector(plan, SamplingProcessLauncher(plan, plan.shards(3)), 3, print)
collector.begin()
print("ready", flush=True)
for iteration in range(10**9):
    if sys.argv[2] == "busy":
        collector.collect(iteration, parameters_of(plan))
    else:
        time.sleep(1)
"""


def test_a_worker_is_light(tmp_path: Path) -> None:
    report = tmp_path / "modules"
    command = [sys.executable, "-c", _MEASURE, SUPPORT, str(report)]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=60)
    imported = {name.partition(".")[0] for name in report.read_text().split()}
    assert "headway" in imported
    assert "psutil" not in imported  # which the parent imports: the report is that of a worker
    assert not imported & HEAVY
    # What is not shared with the fork server, where numba and the kernels are imported once.
    assert max(json.loads(done.stdout)) < 60 * MEBIBYTE


@pytest.mark.parametrize("environment", ["the library's", "its own"])
def test_a_worker_imports_the_main_script_only_for_its_environment(tmp_path: Path, environment: str) -> None:
    """Otherwise a script needs neither a main guard nor light imports."""
    script, report = tmp_path / "script.py", tmp_path / "modules"
    script.write_text(_HEAVY_MAIN)
    command = [sys.executable, str(script), SUPPORT, str(report), environment]
    subprocess.run(command, check=True, timeout=60)
    imported = {name.partition(".")[0] for name in report.read_text().split()}
    assert ("pandas" in imported) == (environment == "its own")


@contextmanager
def _collecting(how: str) -> Iterator[tuple[psutil.Popen, list[psutil.Process]]]:
    """A process that collects, and all its descendants: workers, the forkserver, its tracker."""
    command = [sys.executable, "-c", _COLLECT_FOR_EVER, SUPPORT, how]
    with psutil.Popen(command, stdout=subprocess.PIPE, text=True) as parent:
        try:
            assert parent.stdout.readline() == "ready\n"
            yield parent, psutil.Process(parent.pid).children(recursive=True)
        finally:
            if parent.poll() is None:
                parent.kill()


@pytest.mark.parametrize("how", ["busy", "idle"])
def test_a_killed_parent_leaves_neither_processes_nor_shared_memory(how: str) -> None:
    before = set(Path("/dev/shm").iterdir())
    with _collecting(how) as (parent, descendants):
        assert len(descendants) >= 3 + 1
        time.sleep(0.2)
        parent.kill()
        parent.wait(10)
        _, alive = psutil.wait_procs(descendants, timeout=10)
    assert not alive
    assert not [path for path in set(Path("/dev/shm").iterdir()) - before if "headway" in path.name]


def test_a_killed_forkserver_is_replaced() -> None:
    """Workers outlive it, and starting the next worker starts another forkserver."""
    plan = plan_of_toy("visitors")
    notices: list[str] = []
    with collector_of(plan, workers=2, notify=notices.append) as collector:
        collector.begin()
        parameters = parameters_of(plan)
        collector.collect(1, parameters)
        workers = [psutil.Process(process_id) for process_id in collector.process_ids()]
        server = workers[0].parent()
        assert server is not None
        for process in (server, workers[0]):
            process.kill()
            while process.is_running() and process.status() != psutil.STATUS_ZOMBIE:
                time.sleep(0.01)  # not `wait`, which would take the exit code from its parent
        collector.collect(2, parameters)
        assert "replaced" in notices[0]
        processes = workers + [psutil.Process(process_id) for process_id in collector.process_ids()]
    _, alive = psutil.wait_procs(processes, timeout=10)
    assert not alive


def test_collectors_leave_no_descriptors_and_no_processes() -> None:
    plan = plan_of_toy("trivial")

    def once() -> list[psutil.Process]:
        with collector_of(plan, workers=2) as collector:
            collector.begin()
            collector.collect(1, parameters_of(plan))
            return [psutil.Process(process_id) for process_id in collector.process_ids()]

    once()  # starts the forkserver, which stays
    gc.collect()
    before = psutil.Process().num_fds()
    processes = [process for _ in range(5) for process in once()]
    gc.collect()
    assert psutil.Process().num_fds() == before
    assert not any(process.is_running() for process in processes)


def test_a_hundred_iterations_use_no_more_than_ten() -> None:
    plan = plan_of_toy("trivial", seeds=(5, 6), copies=8, steps=50)
    parameters = parameters_of(plan)
    with collector_of(plan, workers=2) as collector:
        assert isinstance(collector, PoolCollector)
        processes = [psutil.Process(), *map(psutil.Process, collector.process_ids())]

        def used() -> tuple[list[int], int]:
            gc.collect()
            descriptors = sum(process.num_fds() for process in processes)
            return [process.memory_info().rss for process in processes], descriptors

        collector.begin()
        for iteration in range(1, 101):
            collector.collect(iteration, parameters)
            collector.evaluate(7, 2, False, parameters)
            if iteration == 10:
                early, early_descriptors = used()
        late, late_descriptors = used()
    assert late_descriptors == early_descriptors
    assert all(b - a < 4 * MEBIBYTE for a, b in zip(early, late, strict=True)), (early, late)
