"""The jobs of a session, planned and checked before anything starts."""

import os
import shutil
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from math import gcd
from pathlib import Path
from typing import Self

from headway.config.experiment import ExperimentConfig, RolloutConfig
from headway.contracts.environment import EnvSpec
from headway.contracts.errors import HeadwayError
from headway.rollout.plan import RolloutPlan, copies_limit_text, within_limit
from headway.store.atomic_files import make_folder
from headway.training.loop import ParentRun, TrainingJob
from headway.wording import counted
from headway_launch.console.output import print_notice
from headway_launch.experiments.experiment import Experiment, PreparedEnv
from headway_launch.experiments.start import parent_run, start_rule

_FREE_BYTES = 20 * 2**20
_FREE_BYTES_PER_SEED = 10 * 2**20
"""Free space that a session needs. Most runs take 1 to 10 MiB, mostly checkpoints."""
_CHECKPOINTS_AT_ONCE = 3
"""Maximum number of checkpoints on disk: two are kept, and a third is written before the older is deleted."""


@dataclass(frozen=True)
class PlannedJob:
    """One stack of seeds for one training process."""

    experiment: Experiment
    """The experiment as it was requested and is stored."""
    training: TrainingJob
    """The work of its training process, without run folders and workers; blocks as `within_processes` sets
    them."""
    env_spec: EnvSpec
    """Spec of the training environment, with actions in its own units."""
    resumed: tuple[str, ...] = ()
    """Identities of the runs to resume, one per seed; empty for new runs."""
    iteration: int = 0
    """Last durable iteration of the runs to resume; 0 for new runs."""
    workers: int | None = None
    """Number of rollout workers in its checkpoint; None for a new job, which takes its share of the cores."""

    @classmethod
    def of(
        cls,
        experiment: Experiment,
        config: ExperimentConfig,
        environment: PreparedEnv,
        seeds: tuple[int, ...],
    ) -> Self:
        """Return a new job that trains `seeds` with `config`."""
        entry, algo, spec = experiment.env, experiment.algo, environment.spec.for_policies
        plan = RolloutPlan(
            entry.make,
            (*entry.preload, *algo.kernels, *algo.preload),
            environment.prepared,
            spec,
            algo.acting_policy(experiment.algo_config, spec),
            seeds,
            config.rollout.copies,
            config.rollout.steps,
            config.rollout.block,
            environment.training,
            make_contributor=algo.contributor
            and partial(algo.contributor, experiment.algo_config, spec, seeds),
        )
        later_plans = tuple(
            replace(plan, training_prepared=data, stage=stage)
            for stage, data in enumerate(environment.stages)
            if stage > 0
        )
        rule = start_rule(experiment, environment)
        plan = replace(plan, rule=rule, rule_iterations=config.rule_iterations)
        training = TrainingJob(
            plan,
            algo.learner,
            experiment.algo_config,
            replace(config, seed=seeds),
            later_plans=later_plans,
        )
        return cls(experiment, training, environment.spec)

    def with_parent(self, parent: ParentRun | None) -> Self:
        """Return the job as one that starts from another run."""
        return replace(self, training=replace(self.training, parent=parent))

    @property
    def seeds(self) -> tuple[int, ...]:
        """Seeds of the stack."""
        return self.training.seeds

    @property
    def config(self) -> ExperimentConfig:
        """The configuration as trained, of these seeds."""
        return self.training.config


@dataclass(frozen=True)
class CellPlan:
    """The work of a session for one experiment: all seeds of one configuration."""

    experiment: Experiment
    jobs: tuple[PlannedJob, ...]
    finished: tuple[Path, ...] = ()
    """Folders of runs that finished in earlier sessions and count as results."""
    label: str = ""
    """Name of the cell in a session with several; empty otherwise."""
    known_runs: frozenset[str] | None = None
    """Identities of all runs of its seeds when it was planned: seeds for which another session has begun a
    run since are left to that session. None: all seeds are trained."""
    elsewhere: tuple[Path, ...] = ()
    """Folders of runs of its seeds that other sessions were training when it was planned."""
    temporary: bool = False
    """Whether its store is deleted at the end of the session: a failure then names no file there."""


def plan_jobs(experiment: Experiment) -> tuple[PlannedJob, ...]:
    """Return the jobs of a new experiment. Raises HeadwayError if it cannot run."""
    return new_jobs(experiment, experiment.config.seed)


def new_jobs(
    experiment: Experiment, seeds: Sequence[int], known: dict[str, PreparedEnv] | None = None
) -> tuple[PlannedJob, ...]:
    """Return the jobs that train `seeds` of an experiment.

    `known`: environments prepared before, as in `Experiment.prepare`.

    Raises HeadwayError as `Experiment.prepare` does, for a budget that the algorithm refuses, and if the
    environment's file has changed since its digest was stored.
    """
    experiment.require_unchanged_files()
    environment = experiment.prepare(known)
    requested = experiment.config
    if reason := experiment.algo.refuses_budget(experiment.algo_config, requested.iterations):
        raise HeadwayError(
            f"with {counted(requested.iterations, 'iteration')} of {requested.iteration_steps} steps "
            f"(rollout.copies x rollout.steps) {reason}"
        )
    if experiment.algo.contributor is None:
        config = within_processes(requested, environment.spec)
    else:
        if len(environment.stages) > 1:
            raise HeadwayError(
                f"stages: the workers of {experiment.algo_name} do not wait for each other, so that stages "
                "have no common end; use another algorithm, such as algo=ia2c"
            )
        config = _one_worker_per_block(requested, environment.spec, experiment.algo_name)
        _print_workers(config.rollout, experiment.algo_name)
    stack = config.backend.stack
    jobs = [
        PlannedJob.of(experiment, config, environment, tuple(seeds[first : first + stack]))
        for first in range(0, len(seeds), stack)
    ]
    if config.start.rule is not None:
        steps = config.rule_iterations * config.iteration_steps
        print_notice(
            f"rule {config.start.rule} acts in the first {steps:,} steps of each run, and policies "
            "learn to imitate it"
        )
    parent = parent_run(experiment, jobs[0].training.plan.policy)
    return tuple(job.with_parent(parent) for job in jobs)


def within_processes(config: ExperimentConfig, spec: EnvSpec) -> ExperimentConfig:
    """Return the configuration with blocks and workers that respect the environment's copies per process.

    Raises HeadwayError if the settings do not allow it.
    """
    limit, rollout, backend = spec.max_copies_per_process, config.rollout, config.backend
    if limit is None:
        return config
    stack = min(backend.stack, len(config.seed))
    if backend.name == "serial":
        if stack * rollout.copies > limit:
            ways = f"{_serial_settings(limit, stack, rollout)}, or {_process_settings(limit, stack, config)}"
            raise HeadwayError(f"{copies_limit_text(spec, limit)}; set {ways}")
        return config
    block, workers = within_limit(limit, stack, rollout.copies, rollout.block)
    if backend.workers is not None and backend.workers < workers:
        raise HeadwayError(
            f"{copies_limit_text(spec, limit)}; set backend.workers={workers}, or leave it out"
        )
    return replace(
        config,
        rollout=replace(rollout, block=block),
        backend=replace(backend, workers=backend.workers or workers),
    )


def _serial_settings(limit: int, stack: int, rollout: RolloutConfig) -> str:
    """Return settings with which a single process holds at most `limit` copies."""
    if rollout.copies <= limit < stack:
        return f"backend.stack={limit // rollout.copies}"
    copies = limit // stack or limit
    settings = ["backend.stack=1"] if limit < stack else []
    settings.append(f"rollout.copies={copies}")
    if copies % rollout.block:
        settings.append(f"rollout.block={gcd(copies, rollout.block)}")
    return " and ".join(settings)


def _process_settings(limit: int, stack: int, config: ExperimentConfig) -> str:
    """Return settings with which each of several processes holds at most `limit` copies."""
    _, workers = within_limit(limit, stack, config.rollout.copies, config.rollout.block)
    few = config.backend.workers is not None and config.backend.workers < workers
    return f"backend=process and backend.workers={workers}" if few else "backend=process"


def _one_worker_per_block(requested: ExperimentConfig, spec: EnvSpec, algorithm: str) -> ExperimentConfig:
    """Return the configuration of an asynchronous algorithm, with one worker per block.

    Blocks respect the environment's limit of copies per process, as in `within_processes`. Raises
    HeadwayError if the settings require anything else.
    """
    if min(requested.backend.stack, len(requested.seed)) > 1:
        raise HeadwayError(
            f"{algorithm} trains one seed per process, because its workers compute the gradients on CPUs and "
            "stacking gains nothing; set backend.stack=1"
        )
    config = within_processes(replace(requested, backend=replace(requested.backend, workers=None)), spec)
    if config.backend.name == "serial":
        return replace(config, backend=requested.backend)
    workers = config.rollout.copies // config.rollout.block
    if requested.backend.workers not in (None, workers):
        raise HeadwayError(
            f"{algorithm} has one worker per block of copies, {workers} here, because the number of workers "
            "changes the results; leave out backend.workers and set rollout.block"
        )
    return replace(config, backend=replace(config.backend, workers=workers))


def _print_workers(rollout: RolloutConfig, algorithm: str) -> None:
    """Print the number of workers and the rollout length of an asynchronous algorithm.

    They determine the number of gradients.
    """
    number = rollout.copies // rollout.block
    workers = "1 worker" if number == 1 else f"{number} workers"
    print_notice(
        f"{algorithm} has {workers} (rollout.copies / rollout.block) and computes one gradient per "
        f"rollout of {rollout.block} x {rollout.steps} steps"
    )


def require_free_disk(root: Path, jobs: Sequence[PlannedJob], parallel: int) -> None:
    """Raise HeadwayError if the store's folder cannot be written or has too little free space for `jobs`.

    The folder is created if missing; `parallel` jobs run at once.
    """
    make_folder(root)
    if not os.access(root, os.W_OK | os.X_OK):
        raise HeadwayError(f"store.root: {root} cannot be written; set store.root to another folder")
    seeds = sum(len(job.seeds) for job in jobs)
    # Replay buffers are deleted when their job ends, so only parallel jobs count.
    replay = sum(sorted((_replay_bytes(job) for job in jobs), reverse=True)[:parallel])
    free = shutil.disk_usage(root).free
    needed = _FREE_BYTES + seeds * _FREE_BYTES_PER_SEED + replay
    if free < needed:
        raise HeadwayError(
            f"only {free / 2**20:,.0f} MiB are free for the store in {root}, and {seeds} seeds need about "
            f"{needed / 2**20:,.0f} MiB; free some space or set store.root to another disk"
        )


def _replay_bytes(job: PlannedJob) -> int:
    """Return an upper bound on the bytes of a job's stored replay buffers at any time."""
    experiment, spec = job.experiment, job.training.spec
    each = experiment.algo.replay_bytes(experiment.algo_config, spec, experiment.config.env_steps)
    return _CHECKPOINTS_AT_ONCE * len(job.seeds) * each
