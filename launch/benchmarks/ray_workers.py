"""Cost of Ray workers compared with processes on one machine: whole trainings, data transferred, and
throughput of one worker and of two."""

import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from importlib.util import find_spec
from statistics import median

import numpy as np
from numpy.typing import NDArray

from benchmarks.measurement import Task
from benchmarks.training import BASE, interleaved
from headway.config.experiment import BackendConfig
from headway.config.schema import build
from headway.registry import algo_entry, env_entry
from headway.rollout.plan import RolloutPlan
from headway.rollout.pool_collector import PoolCollector

TASKS = {
    "batched trivial, 20 copies": replace(BASE, block=10, workers=2),
    "dict-based trivial, 20 copies": replace(BASE, block=10, workers=2, dict_based=True),
    "bus line, 32 copies": replace(BASE, env="bus", copies=32, steps=125, block=4, workers=2, iterations=8),
}
"""Tasks by name, each with 4,000 environment steps per iteration."""
_REPEATS = 50
_LARGE = 16 * 2**20
"""Size of an answer whose cost is dominated by its size, bytes."""


def report() -> None:
    """Print the tables."""
    print("\n## Ray: two workers as actors and as processes, 4,000 environment steps per iteration\n")
    if find_spec("ray") is None:
        print('Ray is not installed: pip install "headway[ray]"')
        return
    print("Medians of interleaved rounds; seconds and CPU seconds per iteration.\n")
    print("| task | process, s | Ray, s | change | process, CPU s | Ray, CPU s | change "
          "| Ray, steps/s: 1 worker | 2 workers |")  # fmt: skip
    print(f"|---|{'---:|' * 8}")
    for name, task in TASKS.items():
        on_ray = replace(task, backend="ray")
        process, two, one = interleaved(
            [replace(task, backend="process"), on_ray, replace(on_ray, workers=1)]
        )
        steps, cells = task.copies * task.steps, []
        for rate in ("per_second", "per_cpu_second"):
            a, b = (median(steps / getattr(each, rate) for each in results) for results in (process, two))
            cells += [f"{a:.3f}", f"{b:.3f}", f"{b / a - 1:.0%}"]
        cells += [f"{median(each.per_second for each in results):,.0f}" for results in (one, two)]
        print(f"| {name} | {' | '.join(cells)} |", flush=True)
    _report_transfer()


def _report_transfer() -> None:
    """Print the transfer costs by task, for tasks with a batched environment, and those of calls."""
    from headway.rollout.workers.ray_cluster import connect, disconnect
    from headway.rollout.workers.ray_workers import SamplingRayLauncher, experience_of

    connect("local")
    print("\n| task | bytes/step | parameters, bytes | publishing, ms | collection, ms |")
    print("|---|---:|---:|---:|---:|")
    try:
        for name, task in TASKS.items():
            if task.dict_based:
                continue
            plan = _plan_of(task)
            shapes = plan.policy.parameter_shapes(plan.replicas)
            parameters = {key: np.zeros(shape, dtype) for key, (shape, dtype) in shapes.items()}
            shards = plan.shards(task.workers)
            launcher = SamplingRayLauncher(BackendConfig("ray"), plan, shards, print)
            collector = PoolCollector(plan, launcher, len(shards), print)
            try:
                collector.begin()
                collector.collect(1, parameters)
                experience = experience_of(collector.trajectory).values()
                sent = sum(array.nbytes for array in experience) / (task.copies * task.steps)
                put = _median_ms(partial(launcher.publish, parameters))
                collected = _median_ms(partial(collector.collect, 2, parameters))
            finally:
                collector.close()
            size = sum(array.nbytes for array in parameters.values())
            print(f"| {name} | {sent:,.0f} | {size:,} | {put:.2f} | {collected:.1f} |", flush=True)
        _report_messages()
    finally:
        disconnect()


class _Answering:
    """A Ray actor that answers with the requested number of bytes."""

    def give(self, count: int) -> NDArray[np.uint8]:
        return np.zeros(count, np.uint8)


def _report_messages() -> None:
    import ray

    actor = ray.remote(num_cpus=0)(_Answering).remote()
    small = _median_ms(lambda: ray.get(actor.give.remote(1)))
    # Copied once, as experience is copied into the trajectory.
    large = _median_ms(lambda: ray.get(actor.give.remote(_LARGE)).copy())
    ray.kill(actor)
    print("\n| call with a small answer, ms | each further MB of an answer, ms |\n|---:|---:|")
    print(f"| {small:.2f} | {(large - small) / (_LARGE / 1e6):.2f} |", flush=True)


def _plan_of(task: Task) -> RolloutPlan:
    entry, algo = env_entry(task.env), algo_entry(task.algo)
    prepared = entry.prepare(build(entry.config, task.env_args))
    spec = entry.make(prepared, 1).spec
    policy = algo.acting_policy(build(algo.record_for(task.algo_args), task.algo_args), spec)
    return RolloutPlan(
        entry.make, entry.preload, prepared, spec, policy, (task.seed,), task.copies, task.steps, task.block
    )


def _median_ms(act: Callable[[], object]) -> float:
    times = []
    for _ in range(_REPEATS):
        began = time.perf_counter()
        act()
        times.append(time.perf_counter() - began)
    return 1000 * median(times)
