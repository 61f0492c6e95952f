"""What it costs to have workers in actors of Ray instead of processes, on one machine: whole trainings in
turn with both, and what goes over the wire."""

import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from importlib.util import find_spec
from statistics import median

import numpy as np
from numpy.typing import NDArray

from headway.config import BackendConfig
from headway.configuration import build
from headway.registry import algo_entry, env_entry
from headway.rollout.plan import RolloutPlan
from headway_launch.benchmarks.measuring import Task
from headway_launch.benchmarks.training import BASE, in_turn

TASKS = {
    "batched trivial, 20 copies": replace(BASE, block=10, workers=2),
    "dict-based trivial, 20 copies": replace(BASE, block=10, workers=2, dict_based=True),
    "bus line, 32 copies": replace(BASE, env="bus", copies=32, steps=125, block=4, workers=2, iterations=8),
}
"""All of 4,000 environment steps an iteration."""
_REPEATS = 50
_LARGE = 16 * 2**20
"""Bytes of an answer large enough for its size to be what it costs."""


def report() -> None:
    """Print the table."""
    print("\n## Ray: two workers as actors and as processes, 4,000 environment steps an iteration\n")
    if find_spec("ray") is None:
        print('Ray is not installed: pip install "headway[ray]"')
        return
    print("Medians of rounds taken in turn; seconds and CPU seconds of one iteration.\n")
    print("| task | process, s | Ray, s | more | process, CPU s | Ray, CPU s | more |")
    print("|---|---:|---:|---:|---:|---:|---:|")
    for name, task in TASKS.items():
        results = in_turn([replace(task, backend=backend) for backend in ("process", "ray")])
        steps = task.copies * task.steps
        seconds = [median(steps / result.per_second for result in of_one) for of_one in results]
        cpu_seconds = [median(steps / result.per_cpu_second for result in of_one) for of_one in results]
        cells = [f"{a:.3f} | {b:.3f} | {b / a - 1:.0%}" for a, b in (seconds, cpu_seconds)]
        print(f"| {name} | {' | '.join(cells)} |", flush=True)
    _report_wire()


def _report_wire() -> None:
    from headway.rollout.actors import Broadcast, actor_collector, experience_of, nbytes_of
    from headway.rollout.cluster import connect, disconnect

    connect("local")
    print("\n| task | bytes a step | parameters, bytes | published in, ms | collected in, ms |")
    print("|---|---:|---:|---:|---:|")
    try:
        for name, task in TASKS.items():
            if task.dict_based:
                continue
            plan = _plan_of(task)
            shapes = plan.policy.parameter_shapes(plan.replicas)
            parameters = {key: np.zeros(shape, dtype) for key, (shape, dtype) in shapes.items()}
            collector = actor_collector(BackendConfig("ray"), plan, task.workers, print)
            try:
                collector.begin()
                collector.collect(1, parameters)
                assert isinstance(collector.exchange, Broadcast)
                sent = nbytes_of(experience_of(collector.trajectory)) / (task.copies * task.steps)
                put = _median_ms(partial(collector.exchange.publish, parameters))
                collected = _median_ms(partial(collector.collect, 2, parameters))
            finally:
                collector.close()
            size = sum(array.nbytes for array in parameters.values())
            print(f"| {name} | {sent:,.0f} | {size:,} | {put:.2f} | {collected:.1f} |", flush=True)
        _report_messages()
    finally:
        disconnect()


class _Answering:
    """An actor that answers with as many bytes as it is asked for."""

    def give(self, count: int) -> NDArray[np.uint8]:
        return np.zeros(count, np.uint8)


def _report_messages() -> None:
    import ray

    actor = ray.remote(num_cpus=0)(_Answering).remote()
    small = _median_ms(lambda: ray.get(actor.give.remote(1)))
    # Copied once, as experience is, to its place in the trajectory.
    large = _median_ms(lambda: ray.get(actor.give.remote(_LARGE)).copy())
    ray.kill(actor)
    print("\n| a call and its answer, ms | each further MB of an answer, ms |\n|---:|---:|")
    print(f"| {small:.2f} | {(large - small) / (_LARGE / 1e6):.2f} |", flush=True)


def _plan_of(task: Task) -> RolloutPlan:
    entry, algo = env_entry(task.env), algo_entry(task.algo)
    prepared = entry.prepare(build(entry.config, task.env_args))
    spec = entry.make(prepared, 1).spec
    policy = algo.acting_policy(build(algo.config, task.algo_args), spec)
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
