"""Small training jobs of IPPO for the tests of the training loop, and their logs in comparable form."""

from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import torch
from rehearsal import TOYS

from headway.config.experiment import (
    BackendConfig,
    EvaluationConfig,
    ExperimentConfig,
    RolloutConfig,
    StoreConfig,
)
from headway.contracts import AlgoEntry, BatchedEnv
from headway.events import Event, Finished, Row
from headway.rollout.plan import RolloutPlan
from headway.store.parquet_log import TABLES, Table, read_rows
from headway.training.loop import TrainingJob, train
from headway_algos.config import ModelConfig
from headway_algos.registry import ENTRIES, configure

Backend = Literal["serial", "process"]
Log = dict[Table, list[dict[str, str]]]
COPIES, STEPS = 4, 16


GRU: dict[str, Any] = {"gru_size": 4, "sequence_length": 6}


def job_of(
    folder: Path,
    env: tuple[Callable[[Any, int], BatchedEnv], Any] = TOYS["visitors"],
    seeds: Sequence[int] = (5,),
    backend: Backend = "serial",
    workers: int = 2,
    iterations: int = 6,
    block: int = 2,
    checkpoint_every: int = 2,
    precision: Literal["float32", "float64"] = "float32",
    resume: bool = False,
    core: Literal["none", "gru"] = "none",
) -> TrainingJob:
    """Return a job whose run folders are `folder`/seed."""
    model = ModelConfig(hidden=(8,), core=core, **(GRU if core == "gru" else {}))
    algo = configure("ippo", model=model, epochs=2, minibatches=2, precision=precision)
    make, prepared = env
    with closing(make(prepared, 1)) as one:
        spec = one.spec.for_policies
    rollout, policy = RolloutConfig(COPIES, STEPS, block), ENTRIES["ippo"].acting_policy(algo, spec)
    return TrainingJob(
        RolloutPlan(make, (), prepared, spec, policy, tuple(seeds), COPIES, STEPS, block),
        ENTRIES["ippo"].learner,
        algo,
        ExperimentConfig(
            seed=tuple(seeds), env_steps=iterations * COPIES * STEPS, device="cpu", rollout=rollout,
            backend=BackendConfig(backend),
            evaluation=EvaluationConfig(episodes=2, every=2 * COPIES * STEPS, final_episodes=3),
            store=StoreConfig(checkpoint_every=checkpoint_every),
        ),
        workers,
        directories=tuple(str(folder / str(seed)) for seed in seeds),
        resume=resume,
    )  # fmt: skip


def with_algorithm(job: TrainingJob, entry: AlgoEntry, config: object) -> TrainingJob:
    """Return `job` with another algorithm."""
    plan = replace(
        job.plan,
        preload=(*job.plan.preload, *entry.preload),
        policy=entry.acting_policy(config, job.spec),
        make_contributor=entry.contributor and partial(entry.contributor, config, job.spec, job.seeds),
    )
    return replace(job, plan=plan, make_learner=entry.learner, algo_config=config)


def trained(job: TrainingJob, stop_after: int | None = None) -> list[Event]:
    """Train a job to its end, or stop it after `stop_after` iterations; return its events."""
    events: list[Event] = []
    asked = 0

    def should_stop() -> bool:
        nonlocal asked
        asked += 1
        return stop_after is not None and asked > stop_after

    train(job, events.append, should_stop)
    assert isinstance(events[-1], Finished)
    return events


def train_quietly(job: TrainingJob) -> None:
    """Train a job in a separate process."""
    torch.set_num_threads(1)
    trained(job)


def log_of(directory: str | Path) -> Log:
    """Return all tables of a run without times, with every number to its last bit."""
    return {table: [_exact(row) for row in read_rows(Path(directory), table)] for table in TABLES}


def _exact(row: Row) -> dict[str, str]:
    return {
        name: value.hex() if isinstance(value, float) else repr(value)
        for name, value in row.items()
        if name != "wall_s" and not name.startswith("time/")
    }


def logs_of(job: TrainingJob) -> list[Log]:
    """Return one log per seed."""
    return [log_of(directory) for directory in job.directories]
