"""Ray workers sample the same data as worker processes, and are replaced in the same way."""

import importlib.util
import subprocess
import sys
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from ray_processes import assert_gone, ray_processes
from rehearsal import (
    VISITORS,
    Arrays,
    Fault,
    FaultConfig,
    FaultyVisitors,
    LoneVisitors,
    Showing,
    Taken,
    assert_same,
    backend_of,
    collector_of,
    iterations_of,
    parameters_of,
    plan_of,
    plan_of_toy,
)

from headway.config.experiment import BackendConfig
from headway.contracts import HeadwayError
from headway.rollout.backends import open_collector, open_contributors
from headway.rollout.plan import RolloutPlan
from headway.rollout.workers import ray_cluster
from headway.rollout.workers.worker import Contribute
from headway.rollout.workers.worker_pool import WorkerFailedError

SUPPORT = str(Path(__file__).parents[3] / "support")
without_ray = importlib.util.find_spec("ray") is None
needs_ray = pytest.mark.skipif(without_ray, reason='Ray is not installed: pip install "headway[ray]"')


@pytest.fixture(scope="module")
def local(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """The address of a local cluster that this process, with two modules `crossroads`, is connected to."""
    if without_ray:
        pytest.skip("Ray is not installed")
    before = ray_processes()
    with pytest.MonkeyPatch.context() as patch:
        for place in ("installed", "first"):
            folder = tmp_path_factory.mktemp(place)
            (folder / "crossroads.py").write_text(f"PLACE = {place!r}")
            patch.syspath_prepend(folder)
        address = ray_cluster.connect("local")
        yield address
        ray_cluster.disconnect()
    assert_gone(before)


@pytest.mark.cluster
@needs_ray
@pytest.mark.usefixtures("local")
def test_workers_import_the_same_modules_as_this_process() -> None:
    """If two modules have one name, for instance in another checkout, both processes import the same one."""
    import ray

    def place() -> str:
        return str(importlib.import_module("crossroads").PLACE)

    assert ray.get(ray.remote(num_cpus=0)(place).remote()) == "first"


def _collected(
    plan: RolloutPlan, name: str, workers: int, notices: list[str], timeout_s: float | None = None
) -> list[Taken]:
    with collector_of(plan, name, workers, notices.append, timeout_s) as collector:
        collector.begin()
        return iterations_of(collector, parameters_of(plan), 1, 3)


@pytest.mark.cluster
@needs_ray
@pytest.mark.usefixtures("local")
def test_ray_workers_equal_processes_bit_for_bit() -> None:
    plan = plan_of_toy("tracking", seeds=(5, 6), core="gru")
    parameters, given = parameters_of(plan), []
    with collector_of(plan, "process", 2) as processes, collector_of(plan, "ray", 2) as actors:
        for collector in (processes, actors):
            collector.begin()
            evaluated = collector.evaluate(7, 23, False, parameters)
            first = iterations_of(collector, parameters, 1, 2)
            given.append((evaluated, first, collector.snapshot()))
            assert len(collector.process_ids()) == 2
            assert collector.usage().cpu_seconds > 0
        assert given[0][0] == given[1][0]
        assert_same(given[0][1], given[1][1])
        # Each backend returns to the other's snapshots.
        third = iterations_of(processes, parameters, 3, 3)
        assert_same(third, iterations_of(actors, parameters, 3, 3))
        for collector, (_, _, snapshots) in zip((processes, actors), given[::-1], strict=True):
            collector.restore(snapshots, 2)
            assert_same(third, iterations_of(collector, parameters, 3, 3))


@pytest.mark.cluster
@needs_ray
@pytest.mark.usefixtures("local")
def test_ray_workers_may_each_hold_one_seed_of_a_stack() -> None:
    """They use the parameters of the iteration; other workers evaluate."""
    plan = plan_of(LoneVisitors, VISITORS, seeds=(5, 6), copies=1)
    early, late, given = parameters_of(plan), parameters_of(replace(plan, seeds=(98, 99))), []
    for name in ("process", "ray"):
        with collector_of(plan, name, 2) as collector:
            collector.begin()
            evaluated = collector.evaluate(7, 3, False, early)
            taken = iterations_of(collector, early, 1, 1) + iterations_of(collector, late, 2, 2)
            given.append((evaluated, taken))
            assert len(collector.process_ids()) == 2 + 1
    assert given[0][0] == given[1][0]
    assert_same(given[0][1], given[1][1])


def _faulty(folder: Path, fault: Fault = "kill", times: int = 1, workers: int = 1) -> RolloutPlan:
    return plan_of(FaultyVisitors, FaultConfig(fault, str(folder), at=30, copies=4 // workers, times=times))


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> list[Taken]:
    """Data of worker processes without a fault."""
    return _collected(_faulty(tmp_path_factory.mktemp("none"), times=0), "process", 2, [])


@pytest.mark.cluster
@needs_ray
@pytest.mark.usefixtures("local")
@pytest.mark.parametrize(
    ("fault", "workers", "reason"),
    [
        ("kill", 2, "its worker process has died"),
        ("raise", 1, "RuntimeError: the bridge is out"),
        (
            "hang",
            1,
            "no answer for 5 s while stepping faulty in iteration 2; if it is only slow, set a higher "
            "backend.worker_timeout_s",
        ),
    ],
)
def test_a_ray_worker_that_fails_does_not_change_the_data(
    tmp_path: Path,
    capfd: pytest.CaptureFixture[str],
    undisturbed: list[Taken],
    fault: Fault,
    workers: int,
    reason: str,
) -> None:
    notices: list[str] = []
    timeout_s = 5.0 if fault == "hang" else None
    disturbed = _collected(_faulty(tmp_path, fault, workers=workers), "ray", workers, notices, timeout_s)
    assert_same(undisturbed, disturbed)
    assert notices == [
        f"worker {notices[0][7]} failed ({reason}); replaced, repeating its part from the last snapshot"
    ]
    # Ray's own messages stay out of the terminal.
    assert capfd.readouterr() == ("", "")


@pytest.mark.cluster
@needs_ray
@pytest.mark.usefixtures("local")
def test_a_ray_worker_that_fails_twice_ends_the_run_in_one_line(tmp_path: Path) -> None:
    with pytest.raises(WorkerFailedError, match=r"failed twice \(its worker process has died") as failure:
        _collected(_faulty(tmp_path, times=9), "ray", 1, [])
    assert "\n" not in str(failure.value)


@needs_ray
@pytest.mark.parametrize(
    ("message", "reason"),
    [
        (
            "The actor died unexpectedly before finishing this task.\n\tclass_name: A\n\tpid: 1\n"
            "The actor is dead because its worker process has died. Worker exit type: SYSTEM_ERROR "
            "Worker exit detail: Worker exits unexpectedly. Worker exits with an exit code 3.",
            "its worker process has died, exit code 3",
        ),
        (
            "The actor died because of an error raised in its creation task, ray::A.__init__() (pid=1)\n"
            "  File \"a.py\", line 1\nModuleNotFoundError: No module named 'headway'",
            "ModuleNotFoundError: No module named 'headway'",
        ),
        ("Failed to retrieve object 00ff.", "ObjectLostError: Failed to retrieve object 00ff."),
        ("", "ObjectLostError"),
    ],
)
def test_ray_s_message_about_a_lost_actor_becomes_a_short_reason(message: str, reason: str) -> None:
    from headway.rollout.workers.ray_workers import reason_of

    class ObjectLostError(Exception):
        pass

    assert reason_of(ObjectLostError(message)) == reason


@pytest.mark.cluster
@needs_ray
@pytest.mark.usefixtures("local")
def test_an_error_of_the_user_s_is_raised_without_a_replacement(tmp_path: Path) -> None:
    notices: list[str] = []
    with pytest.raises(HeadwayError, match="environment faulty returned inf as reward"):
        _collected(_faulty(tmp_path, "nan reward"), "ray", 1, notices)
    assert notices == []


@pytest.mark.cluster
@needs_ray
@pytest.mark.usefixtures("local")
def test_contributors_run_in_ray_workers_too() -> None:
    plan = replace(plan_of_toy("visitors", copies=4, block=2), make_contributor=Showing)
    published = parameters_of(plan)
    shown: dict[str, list[Arrays]] = {}
    for name in ("serial", "ray"):
        with closing(open_contributors(backend_of(name), plan, print)) as contributors:
            contributors.begin()
            for worker in range(contributors.number):
                contributors.assign(worker, Contribute(1, 0, published))
            done = dict(contributors.next_done(None)[::2] for _ in range(contributors.number))
            contributions = [done[worker].contribution for worker in sorted(done)]
            shown[name] = [dict(each.arrays) for each in contributions if each is not None]
            evaluated = contributors.evaluate(7, 2, True, published)
            assert len(evaluated[0]) == 2
    assert len(shown["ray"]) == 2
    for serial, actor in zip(shown["serial"], shown["ray"], strict=True):
        for name, array in serial.items():
            if not name.startswith("final"):  # valid in few rows
                np.testing.assert_array_equal(actor[name], array, err_msg=name)


@pytest.mark.cluster
@needs_ray
def test_an_environment_defined_in_a_script_reaches_the_ray_workers(local: str, tmp_path: Path) -> None:
    script = tmp_path / "script.py"
    script.write_text(_SCRIPT)
    command = [sys.executable, str(script), SUPPORT, local]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    assert (done.returncode, done.stdout.strip(), done.stderr) == (0, "8 episodes", "")


_SCRIPT = """
import sys
sys.path.insert(0, sys.argv[1])
from headway.config.experiment import BackendConfig
from headway.rollout.backends import open_collector
from headway_envs.toy.trivial import Trivial, TrivialConfig
from rehearsal import parameters_of, plan_of

class Mine(Trivial):
    pass

if __name__ == "__main__":
    plan = plan_of(Mine, TrivialConfig(agents=3, steps=10))
    collector = open_collector(BackendConfig("ray", address=sys.argv[2], worker_cpus=0), plan, 1, print)
    collector.begin()
    print(len(collector.collect(1, parameters_of(plan))), "episodes")
    collector.close()
"""


@pytest.mark.cluster
@needs_ray
@pytest.mark.usefixtures("local")
def test_a_worker_with_other_versions_is_refused() -> None:
    from headway.rollout.workers.ray_workers import Place, RayLauncher

    launcher = RayLauncher(backend_of("ray"), plan_of_toy("trivial"), [], print)
    try:
        here = Place.here()
        launcher.check_place(0, here)
        with pytest.raises(
            HeadwayError, match=r"worker 3 on far has numpy 1.0, and this machine .*install the same"
        ):
            launcher.check_place(3, replace(here, host="far", versions={**here.versions, "numpy": "1.0"}))
    finally:
        launcher.dismiss([])


@pytest.mark.cluster
@needs_ray
@pytest.mark.usefixtures("local")
def test_a_worker_without_free_cpus_waits_with_a_notice(monkeypatch: pytest.MonkeyPatch) -> None:
    from headway.rollout.workers import ray_workers

    monkeypatch.setattr(ray_workers, "PATIENCE_S", 0.5)
    backend, notices = BackendConfig("ray", worker_cpus=1000), list[str]()

    def notify(line: str) -> None:
        notices.append(line)
        raise KeyboardInterrupt  # the worker would wait for ever

    collector = open_collector(backend, plan_of_toy("trivial"), 1, notify)
    with closing(collector), pytest.raises(KeyboardInterrupt):
        collector.begin()
    assert notices[0].startswith("worker 0 waits for free CPUs: it needs 1000, and ")
