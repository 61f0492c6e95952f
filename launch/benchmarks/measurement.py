"""Measurement of trainings, each in its own process, so that nothing else is included."""

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from headway.adapters.pettingzoo import AdapterOptions, ParallelEnvBatch
from headway.config.experiment import BackendConfig, EvaluationConfig, ExperimentConfig, RolloutConfig
from headway.config.schema import build, plain
from headway.events import Event, IterationFinished, Started
from headway.registry import algo_entry, env_entry

if TYPE_CHECKING:
    from headway_launch.experiments.compose import Experiment

WARM_UP = 2
"""Number of first iterations left out, in which kernels are loaded and memory is first used."""


@dataclass(frozen=True)
class Task:
    """A training to measure."""

    env: str
    algo: str
    env_args: Mapping[str, Any]
    algo_args: Mapping[str, Any]
    copies: int
    steps: int
    block: int
    iterations: int
    dict_based: bool = False
    """True: step the ParallelEnv through the adapter instead of the native batch."""
    backend: str = "serial"
    workers: int = 1
    seed: int = 0
    stack: int = 1
    """Number of seeds trained together, from `seed` on."""
    device: str = "cpu"
    """Where the learner computes."""


@dataclass(frozen=True)
class Measurement:
    """Steps, time and memory of the counted iterations."""

    env_steps: int
    """Environment steps of all seeds."""
    wall_s: float
    cpu_s: float
    collect_s: float
    learn_s: float
    worker_mb: float = 0.0
    """Peak resident memory of a worker or a separate evaluation process, MB; 0 if there is neither."""

    @property
    def per_second(self) -> float:
        """Environment steps per second."""
        return self.env_steps / self.wall_s

    @property
    def per_cpu_second(self) -> float:
        """Environment steps per CPU second, including workers."""
        return self.env_steps / self.cpu_s

    @property
    def collected_per_second(self) -> float:
        """Environment steps per second of collection."""
        return self.env_steps / self.collect_s


def first_part(experiment: "Experiment", env_steps: int) -> Task:
    """Return the first `env_steps` counted steps of an experiment's training, with worker processes."""
    rollout = experiment.config.rollout
    return Task(
        env=experiment.config.env.id,
        algo=experiment.algo_name,
        env_args=plain(experiment.training_env_config),
        algo_args=plain(experiment.algo_config),
        copies=rollout.copies,
        steps=rollout.steps,
        block=rollout.block,
        iterations=-(-env_steps // (rollout.copies * rollout.steps)) + WARM_UP,
        backend="process",
    )


class DictBased:
    """An environment's ParallelEnv as a batch; picklable."""

    def __init__(self, name: str) -> None:
        self.name = name

    def __call__(self, config: Any, copies: int) -> ParallelEnvBatch:  # noqa: ANN401 - as EnvEntry.make
        make = env_entry(self.name).parallel_env
        assert make is not None
        return ParallelEnvBatch(lambda: make(config), copies, self.name, AdapterOptions(shared_reward=True))


def measure(tasks: Sequence[Task]) -> list[Measurement]:
    """Run the tasks in parallel, each in a new process with one thread."""
    threads = {f"{library}_NUM_THREADS": "1" for library in ("OMP", "OPENBLAS", "MKL")}
    command = [sys.executable, "-m", "benchmarks.measurement"]
    processes = [
        subprocess.Popen(
            [*command, json.dumps(asdict(task))],
            stdout=subprocess.PIPE,
            env={**os.environ, **threads},
            text=True,
        )
        for task in tasks
    ]
    outputs = [process.communicate()[0] for process in processes]
    if any(process.returncode for process in processes):
        raise SystemExit("benchmark: a measured process failed; its error is printed above")
    return [Measurement(**json.loads(output.splitlines()[-1])) for output in outputs]


def measure_here(task: Task) -> Measurement:
    """Run a task in this process."""
    from headway.rollout.plan import RolloutPlan
    from headway.training.loop import TrainingJob, train

    entry, algo = env_entry(task.env), algo_entry(task.algo)
    prepared = entry.prepare(build(entry.config, task.env_args))
    seeds = tuple(range(task.seed, task.seed + task.stack))
    make = DictBased(task.env) if task.dict_based else entry.make
    config = ExperimentConfig(
        env_steps=task.copies * task.steps * task.iterations,
        device=task.device,
        rollout=RolloutConfig(task.copies, task.steps, task.block),
        backend=build(BackendConfig, {"name": task.backend}),
        evaluation=EvaluationConfig(episodes=1, final_episodes=1, every=10**6, modes=("greedy",)),
    )
    records: list[tuple[float, float, float, float]] = []
    worker_ids: list[int] = []
    peak_mb = 0.0

    def record(event: Event) -> None:
        nonlocal worker_ids, peak_mb
        if isinstance(event, Started):
            _, *worker_ids = event.process_ids
        if isinstance(event, IterationFinished):
            peak_mb = max([peak_mb, *map(_peak_mb, worker_ids)])
            records.append((time.monotonic(), event.usage.cpu_seconds, event.collect_s, event.learn_s))

    with tempfile.TemporaryDirectory() as folder:
        algo_config: Any = build(algo.record_for(task.algo_args), task.algo_args)
        spec = make(prepared, 1).spec.for_policies
        policy = algo.acting_policy(algo_config, spec)
        preload = (*entry.preload, *algo.kernels, *algo.preload)
        contributor = algo.contributor and partial(algo.contributor, algo_config, spec, seeds)
        job = TrainingJob(
            RolloutPlan.of(
                config.rollout, make, preload, prepared, spec, policy, seeds, make_contributor=contributor
            ),
            algo.learner,
            algo_config,
            config,
            task.workers,
            directories=tuple(str(Path(folder, str(seed))) for seed in seeds),
        )
        train(job, record, lambda: False)
    counted = records[WARM_UP:]
    return Measurement(
        env_steps=task.copies * task.steps * len(counted) * task.stack,
        wall_s=counted[-1][0] - records[WARM_UP - 1][0],
        cpu_s=counted[-1][1] - records[WARM_UP - 1][1],
        collect_s=sum(mark[2] for mark in counted),
        learn_s=sum(mark[3] for mark in counted),
        worker_mb=peak_mb,
    )


def _peak_mb(process_id: int) -> float:
    """Return the peak resident memory of a Linux process, MB; 0 if it has ended."""
    try:
        status = Path(f"/proc/{process_id}/status").read_text(encoding="utf-8")
    except OSError:
        return 0.0
    peaks = [line.split()[1] for line in status.splitlines() if line.startswith("VmHWM:")]
    return int(peaks[0]) / 1024 if peaks else 0.0


if __name__ == "__main__":
    print(json.dumps(asdict(measure_here(Task(**json.loads(sys.argv[1]))))))
