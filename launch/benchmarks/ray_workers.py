"""Cost of Ray workers compared with processes on one machine: whole trainings, data transferred, and
throughput by number of workers, measured for one and two and projected for more."""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from importlib.util import find_spec
from statistics import median

import numpy as np
from numpy.typing import NDArray

from benchmarks.measurement import Measurement, Task
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
_PROJECTED_WORKERS = (4, 8)
"""Numbers of workers to project, if a task has enough blocks of copies for them."""
_OVERLAP = 8
"""Number of concurrent calls; an assumption."""


@dataclass(frozen=True)
class TransferCost:
    """Sizes of transferred data, and times of transfer."""

    bytes_per_step: float
    """Bytes of experience per environment step."""
    parameter_bytes: float
    message_s: float
    """Time of a call with a small answer, s."""
    byte_s: float
    """Additional time per byte of an answer, s."""

    def transfer_s(self, steps: int, workers: int) -> float:
        """Return the transfer time of an iteration of `steps` on one node, s: parameters, calls,
        experience."""
        sent = self.parameter_bytes + self.bytes_per_step * steps
        return self.byte_s * sent + self.message_s * workers / _OVERLAP


@dataclass(frozen=True)
class Growth:
    """Model of an iteration's duration on one node, by the formula of docs/howto/clusters.md."""

    steps: int
    """Environment steps per iteration."""
    blocks: int
    """Number of blocks of copies; a block is never split between workers."""
    worker_s: float
    """Time per step in one worker, s."""
    learn_s: float
    """Time of learning per iteration, s."""
    transfer: TransferCost

    def per_second(self, workers: int) -> float:
        """Return environment steps per second, including learning. The worker with most blocks is the
        slowest."""
        share = -(-self.blocks // workers) / self.blocks
        collect_s = self.steps * self.worker_s * share + self.transfer.transfer_s(self.steps, workers)
        return self.steps / (collect_s + self.learn_s)


def report() -> None:
    """Print the tables."""
    print("\n## Ray: two workers as actors and as processes, 4,000 environment steps per iteration\n")
    if find_spec("ray") is None:
        print('Ray is not installed: pip install "headway[ray]"')
        return
    print("Medians of interleaved rounds; seconds and CPU seconds per iteration.\n")
    print("| task | process, s | Ray, s | change | process, CPU s | Ray, CPU s | change |")
    print("|---|---:|---:|---:|---:|---:|---:|")
    with_ray: dict[str, list[Measurement]] = {}
    for name, task in TASKS.items():
        results = interleaved([replace(task, backend=backend) for backend in ("process", "ray")])
        with_ray[name] = results[1]
        steps = task.copies * task.steps
        seconds = [median(steps / result.per_second for result in of_one) for of_one in results]
        cpu_seconds = [median(steps / result.per_cpu_second for result in of_one) for of_one in results]
        cells = [f"{a:.3f} | {b:.3f} | {b / a - 1:.0%}" for a, b in (seconds, cpu_seconds)]
        print(f"| {name} | {' | '.join(cells)} |", flush=True)
    _report_growth(with_ray, _report_transfer())


def _report_transfer() -> dict[str, TransferCost]:
    """Print and return the transfer costs by task, for tasks with a batched environment."""
    from headway.rollout.workers.ray_cluster import connect, disconnect
    from headway.rollout.workers.ray_workers import SamplingRayLauncher, experience_of

    sizes: dict[str, tuple[float, float]] = {}
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
            sizes[name] = sent, size
            print(f"| {name} | {sent:,.0f} | {size:,} | {put:.2f} | {collected:.1f} |", flush=True)
        message_s, byte_s = _report_messages()
    finally:
        disconnect()
    return {name: TransferCost(*of_one, message_s, byte_s) for name, of_one in sizes.items()}


class _Answering:
    """A Ray actor that answers with the requested number of bytes."""

    def give(self, count: int) -> NDArray[np.uint8]:
        return np.zeros(count, np.uint8)


def _report_messages() -> tuple[float, float]:
    """Return the time of a call with a small answer and the time per further byte, s."""
    import ray

    actor = ray.remote(num_cpus=0)(_Answering).remote()
    small = _median_ms(lambda: ray.get(actor.give.remote(1)))
    # Copied once, as experience is copied into the trajectory.
    large = _median_ms(lambda: ray.get(actor.give.remote(_LARGE)).copy())
    ray.kill(actor)
    print("\n| call with a small answer, ms | each further MB of an answer, ms |\n|---:|---:|")
    print(f"| {small:.2f} | {(large - small) / (_LARGE / 1e6):.2f} |", flush=True)
    return small / 1000, (large - small) / 1000 / _LARGE


def _report_growth(
    with_two: Mapping[str, Sequence[Measurement]], transfers: Mapping[str, TransferCost]
) -> None:
    """Print the throughput by number of workers: measured for one and two, projected for two and more."""
    projected = " | ".join(f"{workers}, projected" for workers in _PROJECTED_WORKERS)
    print(f"\n| task, environment steps/s | 1 worker, measured | 2, measured (projected) | {projected} |")
    print(f"|---|{'---:|' * (2 + len(_PROJECTED_WORKERS))}")
    for name, transfer in transfers.items():
        task = TASKS[name]
        alone = interleaved([replace(task, backend="ray", workers=1)])[0]
        steps = task.copies * task.steps
        collected_s = 1 / median(result.collected_per_second for result in alone)
        learn_s = steps * median(result.learn_s / result.env_steps for result in alone)
        # The measured collection time of one worker includes the transfer.
        worker_s = max(collected_s - transfer.transfer_s(steps, 1) / steps, 0.0)
        growth = Growth(steps, task.copies // task.block, worker_s, learn_s, transfer)
        one, two = (median(result.per_second for result in results) for results in (alone, with_two[name]))
        cells = growth_cells(growth, one, two)
        print(f"| {name} | {' | '.join(cells)} |", flush=True)
    print(
        "\nProjected from the measured single worker, for equally fast workers on one node. Assumed, not "
        f"measured: {_OVERLAP} concurrent calls. Blocks of copies are not split between workers, so "
        "nothing is projected for more workers than blocks (a smaller rollout.block gives more)."
    )


def growth_cells(growth: Growth, one: float, two: float) -> list[str]:
    """Return table cells: steps per second measured with one worker, measured and projected with two, and
    projected with more; empty for more workers than blocks."""
    projected = [
        f"{growth.per_second(workers):,.0f}" if workers <= growth.blocks else ""
        for workers in (2, *_PROJECTED_WORKERS)
    ]
    return [f"{one:,.0f}", f"{two:,.0f} ({projected[0]})", *projected[1:]]


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
