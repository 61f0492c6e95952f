"""What it costs to have workers in actors of Ray instead of processes, on one machine: whole trainings in
turn with both, what goes over the wire, and how throughput grows with workers: measured for one and two, and
planned beyond from what was measured."""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from importlib.util import find_spec
from statistics import median

import numpy as np
from numpy.typing import NDArray

from benchmarks.measurement import Measurement, Task
from benchmarks.training import BASE, in_turn
from headway.config.experiment import BackendConfig
from headway.config.schema import build
from headway.registry import algo_entry, env_entry
from headway.rollout.plan import RolloutPlan

TASKS = {
    "batched trivial, 20 copies": replace(BASE, block=10, workers=2),
    "dict-based trivial, 20 copies": replace(BASE, block=10, workers=2, dict_based=True),
    "bus line, 32 copies": replace(BASE, env="bus", copies=32, steps=125, block=4, workers=2, iterations=8),
}
"""All of 4,000 environment steps an iteration."""
_REPEATS = 50
_LARGE = 16 * 2**20
"""Bytes of an answer large enough for its size to be what it costs."""
_PLANNED_WORKERS = (4, 8)
"""Of how many workers a plan is made, where a task has as many blocks of copies for them."""
_OVERLAP = 8
"""How many calls and answers are under way at once: assumed."""


@dataclass(frozen=True)
class Wire:
    """What goes over it, and what that takes."""

    bytes_a_step: float
    parameter_bytes: float
    message_s: float
    """A call and its answer."""
    byte_s: float
    """Each further byte of an answer."""

    def sent_s(self, steps: int, workers: int) -> float:
        """Of an iteration of so many steps on one node: parameters to it, calls, experience from it."""
        sent = self.parameter_bytes + self.bytes_a_step * steps
        return self.byte_s * sent + self.message_s * workers / _OVERLAP


@dataclass(frozen=True)
class Growth:
    """What an iteration takes on one node, by the formula of CLUSTERS.md."""

    steps: int
    """Environment steps an iteration."""
    blocks: int
    """Of copies: workers have whole ones, whatever their number."""
    worker_s: float
    """Seconds a step in one worker."""
    learn_s: float
    """Seconds an iteration."""
    wire: Wire

    def per_second(self, workers: int) -> float:
        """Environment steps a second, learning included. A worker with most blocks is waited for."""
        share = -(-self.blocks // workers) / self.blocks
        collect_s = self.steps * self.worker_s * share + self.wire.sent_s(self.steps, workers)
        return self.steps / (collect_s + self.learn_s)


def report() -> None:
    """Print the table."""
    print("\n## Ray: two workers as actors and as processes, 4,000 environment steps an iteration\n")
    if find_spec("ray") is None:
        print('Ray is not installed: pip install "headway[ray]"')
        return
    print("Medians of rounds taken in turn; seconds and CPU seconds of one iteration.\n")
    print("| task | process, s | Ray, s | more | process, CPU s | Ray, CPU s | more |")
    print("|---|---:|---:|---:|---:|---:|---:|")
    with_ray: dict[str, list[Measurement]] = {}
    for name, task in TASKS.items():
        results = in_turn([replace(task, backend=backend) for backend in ("process", "ray")])
        with_ray[name] = results[1]
        steps = task.copies * task.steps
        seconds = [median(steps / result.per_second for result in of_one) for of_one in results]
        cpu_seconds = [median(steps / result.per_cpu_second for result in of_one) for of_one in results]
        cells = [f"{a:.3f} | {b:.3f} | {b / a - 1:.0%}" for a, b in (seconds, cpu_seconds)]
        print(f"| {name} | {' | '.join(cells)} |", flush=True)
    _report_growth(with_ray, _report_wire())


def _report_wire() -> dict[str, Wire]:
    """By task, of those whose environment is a batch."""
    from headway.rollout.workers.ray_cluster import connect, disconnect
    from headway.rollout.workers.ray_workers import (
        RaySamplingTransport,
        experience_of,
        nbytes_of,
        ray_collector,
    )

    sizes: dict[str, tuple[float, float]] = {}
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
            collector = ray_collector(BackendConfig("ray"), plan, plan.shards(task.workers), print)
            try:
                collector.begin()
                collector.collect(1, parameters)
                assert isinstance(collector.transport, RaySamplingTransport)
                sent = nbytes_of(experience_of(collector.trajectory)) / (task.copies * task.steps)
                put = _median_ms(partial(collector.transport.publish, parameters))
                collected = _median_ms(partial(collector.collect, 2, parameters))
            finally:
                collector.close()
            size = sum(array.nbytes for array in parameters.values())
            sizes[name] = sent, size
            print(f"| {name} | {sent:,.0f} | {size:,} | {put:.2f} | {collected:.1f} |", flush=True)
        message_s, byte_s = _report_messages()
    finally:
        disconnect()
    return {name: Wire(*of_one, message_s, byte_s) for name, of_one in sizes.items()}


class _Answering:
    """An actor that answers with as many bytes as it is asked for."""

    def give(self, count: int) -> NDArray[np.uint8]:
        return np.zeros(count, np.uint8)


def _report_messages() -> tuple[float, float]:
    """Seconds of a call and its answer, and of each further byte."""
    import ray

    actor = ray.remote(num_cpus=0)(_Answering).remote()
    small = _median_ms(lambda: ray.get(actor.give.remote(1)))
    # Copied once, as experience is, to its place in the trajectory.
    large = _median_ms(lambda: ray.get(actor.give.remote(_LARGE)).copy())
    ray.kill(actor)
    print("\n| a call and its answer, ms | each further MB of an answer, ms |\n|---:|---:|")
    print(f"| {small:.2f} | {(large - small) / (_LARGE / 1e6):.2f} |", flush=True)
    return small / 1000, (large - small) / 1000 / _LARGE


def _report_growth(with_two: Mapping[str, Sequence[Measurement]], wires: Mapping[str, Wire]) -> None:
    """Throughput by workers: what one and two give here, and what the formula gives for all."""
    planned = " | ".join(f"{workers}, planned" for workers in _PLANNED_WORKERS)
    print(f"\n| task, environment steps a second | 1 worker, measured | 2, measured (planned) | {planned} |")
    print(f"|---|{'---:|' * (2 + len(_PLANNED_WORKERS))}")
    for name, wire in wires.items():
        task = TASKS[name]
        alone = in_turn([replace(task, backend="ray", workers=1)])[0]
        steps = task.copies * task.steps
        collected_s = 1 / median(result.collected_per_second for result in alone)
        learn_s = steps * median(result.learn_s / result.env_steps for result in alone)
        # What one worker's collection took holds what went over the wire, too.
        worker_s = max(collected_s - wire.sent_s(steps, 1) / steps, 0.0)
        growth = Growth(steps, task.copies // task.block, worker_s, learn_s, wire)
        one, two = (median(result.per_second for result in results) for results in (alone, with_two[name]))
        cells = growth_cells(growth, one, two)
        print(f"| {name} | {' | '.join(cells)} |", flush=True)
    print(
        "\nPlanned from the one worker measured, with all workers as fast as it, on one node. Assumed, not "
        f"measured: {_OVERLAP} calls and answers under way at once. Workers have whole blocks of copies, "
        "which get no smaller with more workers: nothing is planned for more than a task has blocks (a "
        "smaller rollout.block has more)."
    )


def growth_cells(growth: Growth, one: float, two: float) -> list[str]:
    """Steps a second as measured with one worker and with two, and planned for two and more, empty for more
    than there are blocks. Of one nothing is planned: the plan was made from it."""
    planned = [
        f"{growth.per_second(workers):,.0f}" if workers <= growth.blocks else ""
        for workers in (2, *_PLANNED_WORKERS)
    ]
    return [f"{one:,.0f}", f"{two:,.0f} ({planned[0]})", *planned[1:]]


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
