"""Measurement of trainings, each in its own process, so that nothing else is included."""

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from headway.adapters.pettingzoo import AdapterOptions, ParallelEnvBatch
from headway.events import Event, IterationFinished
from headway.registry import env_entry

if TYPE_CHECKING:
    from headway_launch.runner.jobs import PlannedJob

WARM_UP = 2
"""Number of first iterations left out, in which kernels are loaded and memory is first used."""


@dataclass(frozen=True)
class Task:
    """A training to measure, without evaluations."""

    words: tuple[str, ...]
    """Overrides, as `headway run` takes them; the seeds must form one stack."""
    env_steps: int
    """Environment steps of the counted iterations, per seed."""
    dict_based: bool = False
    """True: step the ParallelEnv through the adapter instead of the native batch."""

    def having(self, *words: str) -> "Task":
        """Return the task with further words, in place of those of the same keys."""
        keys = {word.partition("=")[0] for word in words}
        kept = (word for word in self.words if word.partition("=")[0] not in keys)
        return replace(self, words=(*kept, *words))

    def planned(self) -> "PlannedJob":
        """Return the job. Raises HeadwayError for words that do not describe one."""
        from headway_launch.experiments.compose import compose
        from headway_launch.runner.jobs import plan_jobs

        once = ("evaluation.episodes=1", "evaluation.final_episodes=1", "evaluation.modes=[greedy]")
        experiment = compose([*self.words, *once, "evaluation.every=1_000_000_000", "evaluation.rules=[]"])
        config = experiment.config
        iterations = -(-self.env_steps // config.iteration_steps) + WARM_UP
        steps = iterations * config.iteration_steps
        [job] = plan_jobs(replace(experiment, config=replace(config, env_steps=steps)))
        return job


@dataclass(frozen=True)
class Measurement:
    """Steps, time and memory of the counted iterations."""

    env_steps: int
    """Environment steps of all seeds."""
    wall_s: float
    cpu_s: float
    collect_s: float
    learn_s: float

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
    from headway.training.loop import train
    from headway_launch.runner.cores import CoreShares, workers_of

    planned = task.planned()
    job, rollout = planned.training, planned.config.rollout
    if task.dict_based:
        make = DictBased(planned.config.env.id)
        spec = make(job.plan.prepared, 1).spec.for_policies
        job = replace(job, plan=replace(job.plan, make_env=make, spec=spec))
    records: list[tuple[float, float, float, float]] = []

    def record(event: Event) -> None:
        if isinstance(event, IterationFinished):
            records.append((time.monotonic(), event.usage.cpu_seconds, event.collect_s, event.learn_s))

    with tempfile.TemporaryDirectory() as folder:
        folders = tuple(str(Path(folder, str(seed))) for seed in job.seeds)
        workers = workers_of(planned, CoreShares(parallel=1, workers=1))
        train(replace(job, workers=workers, directories=folders), record, lambda: False)
    counted = records[WARM_UP:]
    return Measurement(
        env_steps=rollout.copies * rollout.steps * len(counted) * len(job.seeds),
        wall_s=counted[-1][0] - records[WARM_UP - 1][0],
        cpu_s=counted[-1][1] - records[WARM_UP - 1][1],
        collect_s=sum(mark[2] for mark in counted),
        learn_s=sum(mark[3] for mark in counted),
    )


if __name__ == "__main__":
    print(json.dumps(asdict(measure_here(Task(**json.loads(sys.argv[1]))))))
