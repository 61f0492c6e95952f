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

from benchmarks.training import BASE, ITERATION_STEPS, bus_line, interleaved
from headway.config.experiment import BackendConfig
from headway.rollout.pool_collector import PoolCollector

_ON_TWO = ("backend=process", "backend.workers=2")
_TRIVIAL = BASE.having(*_ON_TWO, "rollout.block=10")
TASKS = {
    "batched trivial, 20 copies": _TRIVIAL,
    "dict-based trivial, 20 copies": replace(_TRIVIAL, dict_based=True),
    "bus line, 32 copies": bus_line(32, 125).having(*_ON_TWO),
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
        on_ray = task.having("backend=ray")
        process, two, one = interleaved([task, on_ray, on_ray.having("backend.workers=1")])
        cells = []
        for rate in ("per_second", "per_cpu_second"):
            a, b = (
                median(ITERATION_STEPS / getattr(each, rate) for each in results)
                for results in (process, two)
            )
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
            plan = task.planned().training.plan
            shapes = plan.policy.parameter_shapes(plan.replicas)
            parameters = {key: np.zeros(shape, dtype) for key, (shape, dtype) in shapes.items()}
            shards = plan.shards(2)
            launcher = SamplingRayLauncher(BackendConfig("ray"), plan, shards, print)
            collector = PoolCollector(plan, launcher, len(shards), print)
            try:
                collector.begin()
                collector.collect(1, parameters)
                experience = experience_of(collector.trajectory).values()
                sent = sum(array.nbytes for array in experience) / ITERATION_STEPS
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


def _median_ms(act: Callable[[], object]) -> float:
    times = []
    for _ in range(_REPEATS):
        began = time.perf_counter()
        act()
        times.append(time.perf_counter() - began)
    return 1000 * median(times)
