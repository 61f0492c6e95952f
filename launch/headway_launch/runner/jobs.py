"""What a session will do, decided and checked before anything starts."""

import os
import shutil
from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import gcd
from pathlib import Path
from typing import Any

from headway.config.experiment import BackendConfig, ExperimentConfig, RolloutConfig
from headway.contracts.environment import EnvSpec
from headway.contracts.errors import HeadwayError
from headway.rollout.plan import process_holds, replica_groups, within_limit
from headway.store.atomic_files import make_folder
from headway.training.loop import TrainingJob
from headway_launch.console.output import tell
from headway_launch.experiments.compose import Experiment, PreparedEnv

_FREE_BYTES = 200 * 2**20
_FREE_BYTES_A_SEED = 10 * 2**20
_CHECKPOINTS_AT_ONCE = 3
"""Two are kept, and a third is written before the oldest goes."""


@dataclass(frozen=True)
class PlannedJob:
    """One stack of seeds that one training process will train."""

    experiment: Experiment
    """As it was asked for, and is kept."""
    config: ExperimentConfig
    """As it trains: with blocks and workers as `within_processes` has them."""
    prepared: Any
    """What `EnvEntry.prepare` gave; shared by all jobs of an experiment."""
    training_prepared: Any
    """The same for the environment that is learned from."""
    spec: EnvSpec
    """What is learned from."""
    seeds: tuple[int, ...]
    resumed: tuple[str, ...] = ()
    """Identities of the runs to go on with, one a seed; empty: new ones."""
    iteration: int = 0
    """The last durable one of the runs to go on with."""
    workers: int | None = None
    """Rollout workers that its checkpoint knows; None for a new job, which takes its share of the cores."""

    def training_job(
        self,
        config: ExperimentConfig,
        workers: int,
        directories: Sequence[Path],
        gates: Sequence[Path] = (),
        resume: bool = False,
    ) -> TrainingJob:
        """What its training process is given: how it trains here and now, and the folder of each seed, with
        the gate to it if it has one."""
        experiment = self.experiment
        return TrainingJob(
            make_env=experiment.env.make,
            preload=experiment.env.preload,
            prepared=self.prepared,
            spec=self.spec,
            make_policy=experiment.algo.acting_policy,
            make_learner=experiment.algo.learner,
            algo_config=experiment.algo_config,
            seeds=self.seeds,
            config=replace(config, seed=self.seeds),
            workers=workers,
            directories=tuple(str(directory) for directory in directories),
            gates=tuple(str(gate) for gate in gates),
            resume=resume,
            training_prepared=self.training_prepared,
            make_contributor=experiment.algo.contributor,
            contributor_preload=experiment.algo.preload,
        )


@dataclass(frozen=True)
class Shares:
    """How the cores are shared out."""

    parallel: int
    """Training processes at once."""
    workers: int
    """Rollout workers of each that does not say how many it needs."""


@dataclass(frozen=True)
class CellPlan:
    """What a session has to do for one experiment: all seeds of one configuration."""

    experiment: Experiment
    jobs: tuple[PlannedJob, ...]
    finished: tuple[Path, ...] = ()
    """Folders of runs that finished in earlier sessions, and count."""
    label: str = ""
    """What it is called where a session has several."""


def plan_jobs(experiment: Experiment) -> tuple[PlannedJob, ...]:
    """The jobs of a new experiment. Raises HeadwayError for what cannot run."""
    return new_jobs(experiment, experiment.config.seed)


def new_jobs(
    experiment: Experiment, seeds: Sequence[int], known: dict[str, PreparedEnv] | None = None
) -> tuple[PlannedJob, ...]:
    """The jobs of some seeds of an experiment; `known` as for `Experiment.prepare`, raises as it does, and
    HeadwayError for a budget that its algorithm refuses."""
    found = experiment.prepare(known)
    asked, rollout = experiment.config, experiment.config.rollout
    if reason := experiment.algo.refuses_budget(experiment.algo_config, asked.iterations):
        raise HeadwayError(
            f"in {asked.iterations} x {rollout.copies * rollout.steps} env_steps (iterations x "
            f"rollout.copies x rollout.steps) {reason}"
        )
    if experiment.algo.contributor is None:
        config = within_processes(asked, found.spec)
    else:
        config = _with_a_worker_a_block(asked, found.spec, experiment.algo_name)
        _tell_workers(config.rollout, experiment.algo_name)
    stack = config.backend.stack
    return tuple(
        PlannedJob(
            experiment,
            config,
            found.prepared,
            found.training,
            found.spec,
            tuple(seeds[first : first + stack]),
        )
        for first in range(0, len(seeds), stack)
    )


def within_processes(config: ExperimentConfig, spec: EnvSpec) -> ExperimentConfig:
    """The configuration with blocks small enough, and workers enough, for an environment of which a process
    holds few copies. Raises HeadwayError where what is set does not allow it."""
    limit, rollout, backend = spec.max_copies_per_process, config.rollout, config.backend
    if limit is None:
        return config
    stack = min(backend.stack, len(config.seed))
    if backend.name == "serial":
        if stack * rollout.copies > limit:
            ways = f"{_serially(limit, stack, rollout)}, or {_by_processes(limit, stack, config)}"
            raise HeadwayError(f"{process_holds(spec, limit)}; set {ways}")
        return config
    block, workers = within_limit(limit, stack, rollout.copies, rollout.block)
    if backend.workers is not None and backend.workers < workers:
        raise HeadwayError(f"{process_holds(spec, limit)}; set backend.workers={workers}, or leave it out")
    return replace(
        config,
        rollout=replace(rollout, block=block),
        backend=replace(backend, workers=backend.workers or workers),
    )


def _serially(limit: int, stack: int, rollout: RolloutConfig) -> str:
    """Settings with which one process holds no more than `limit` copies."""
    if rollout.copies <= limit < stack:
        return f"backend.stack={limit // rollout.copies}"
    copies = limit // stack or limit
    settings = ["backend.stack=1"] if limit < stack else []
    settings.append(f"rollout.copies={copies}")
    if copies % rollout.block:
        settings.append(f"rollout.block={gcd(copies, rollout.block)}")
    return " and ".join(settings)


def _by_processes(limit: int, stack: int, config: ExperimentConfig) -> str:
    """Settings with which processes hold no more than `limit` copies each."""
    _, workers = within_limit(limit, stack, config.rollout.copies, config.rollout.block)
    few = config.backend.workers is not None and config.backend.workers < workers
    return f"backend=process and backend.workers={workers}" if few else "backend=process"


def _with_a_worker_a_block(asked: ExperimentConfig, spec: EnvSpec, algorithm: str) -> ExperimentConfig:
    """The configuration as an asynchronous algorithm trains: as `within_processes`, but only blocks decide
    how many workers there are. Raises HeadwayError where something else is set."""
    if min(asked.backend.stack, len(asked.seed)) > 1:
        raise HeadwayError(
            f"{algorithm} trains one seed a process: its gradients are found in workers, on CPUs, where a "
            "stack gains nothing; set backend.stack=1"
        )
    config = within_processes(replace(asked, backend=replace(asked.backend, workers=None)), spec)
    if config.backend.name == "serial":
        return replace(config, backend=asked.backend)
    workers = config.rollout.copies // config.rollout.block
    if asked.backend.workers not in (None, workers):
        raise HeadwayError(
            f"{algorithm} has a worker for each block of copies, {workers} here, as their number changes "
            "what is learned; leave backend.workers out, and set rollout.block"
        )
    return replace(config, backend=replace(config.backend, workers=workers))


def _tell_workers(rollout: RolloutConfig, algorithm: str) -> None:
    """What an asynchronous algorithm learns from, which is not what its neighbours' settings make of it."""
    number = rollout.copies // rollout.block
    workers = "1 worker" if number == 1 else f"{number} workers"
    line = (
        f"headway: {algorithm} has {workers} (rollout.copies / rollout.block), and a gradient of each "
        f"rollout of {rollout.block} x {rollout.steps} steps"
    )
    tell(f"{line}; rollout=asynchronous has more and shorter ones" if rollout == RolloutConfig() else line)


def share_cores(
    backend: BackendConfig,
    jobs: Sequence[PlannedJob],
    cores: int,
    cluster_cpus: int | None = None,
    node_cpus: int | None = None,
) -> Shares:
    """As many training processes as cores (at most one a job); each has its share of the cores as workers,
    or, where workers are on a cluster, of its CPUs. Jobs whose number of workers is fixed run side by side as
    far as these go round: each keeps its place on a cluster, and beside their learner they count as
    `cores_taken` says. `node_cpus`: all that one job can have, where `cores` are of several machines."""
    fixed = [(job, _fixed_workers(job) or 1) for job in jobs]
    if cluster_cpus is None:
        most = max(
            [
                1,
                *(
                    cores_taken(job.spec, len(job.seeds), job.config.rollout.block, workers, node_cpus)
                    for job, workers in fixed
                ),
            ]
        )
    else:
        most = max([1, *(workers for _, workers in fixed)])
    for_workers = cores if cluster_cpus is None else cluster_cpus
    at_once = max(1, min(cores, for_workers // most))
    parallel = max(1, min(backend.parallel or at_once, len(jobs)))
    workers = max(1, for_workers // parallel)
    return Shares(parallel, workers if node_cpus is None else min(workers, node_cpus))


def cores_taken(spec: EnvSpec, seeds: int, block: int, workers: int, node_cpus: int | None = None) -> int:
    """Cores that a training process with its workers beside it counts as, at most those of a machine: one a
    worker, as workers take turns with the learner. Of a stack whose parts have workers of their own only one
    part's count: its learner has as many times more to do, and all of them would leave cores idle
    meanwhile."""
    taken = max(1, workers // len(replica_groups(spec.max_copies_per_process, seeds, block)))
    return taken if node_cpus is None else min(taken, node_cpus)


def workers_of(job: PlannedJob, shares: Shares) -> int:
    """Rollout workers of a job: what its checkpoints were made with, or what it asks for, or its share of the
    cores; a new job has no more than have work to do."""
    return _fixed_workers(job) or min(shares.workers, _most_workers(job))


def _fixed_workers(job: PlannedJob) -> int | None:
    """Rollout workers that a job has however many cores there are; None where it takes its share."""
    if job.workers is not None:
        return job.workers
    backend = job.config.backend
    if backend.name == "serial":
        return 1
    return None if backend.workers is None else min(backend.workers, _most_workers(job))


def _most_workers(job: PlannedJob) -> int:
    """That have work to do: each has a block of the copies of all seeds, or of those that a process can hold
    at once."""
    rollout = job.config.rollout
    return len(_groups(job)) * (rollout.copies // rollout.block)


def _groups(job: PlannedJob) -> list[tuple[int, int]]:
    return replica_groups(job.spec.max_copies_per_process, len(job.seeds), job.config.rollout.block)


def gpus_of(device: str, there: float) -> float:
    """GPUs that a training process asks of a cluster which has so many: `cuda` one, `auto` one if there is
    any."""
    return 1.0 if device.startswith("cuda") or (device == "auto" and there >= 1.0) else 0.0


def uses_gpu(job: PlannedJob) -> bool:
    """Whether a job trains on a GPU."""
    device = job.config.device
    return device.startswith("cuda") or (device == "auto" and Path("/dev/nvidiactl").exists())


def require_free_disk(root: Path, jobs: Sequence[PlannedJob], parallel: int) -> None:
    """Raise HeadwayError if the folder of the store cannot be made or written, or its disk is too full for
    these jobs, `parallel` at once: experience goes with the end of its job."""
    make_folder(root)
    if not os.access(root, os.W_OK | os.X_OK):
        raise HeadwayError(f"store.root: {root} cannot be written; give it another folder")
    seeds = sum(len(job.seeds) for job in jobs)
    experience = sum(sorted((_experience_bytes(job) for job in jobs), reverse=True)[:parallel])
    free = shutil.disk_usage(root).free
    needed = _FREE_BYTES + seeds * _FREE_BYTES_A_SEED + experience
    if free < needed:
        raise HeadwayError(
            f"only {free / 2**20:,.0f} MiB are free for the store in {root}, and {seeds} seeds need about "
            f"{needed / 2**20:,.0f} MiB; free some space or set store.root to another disk"
        )


def _experience_bytes(job: PlannedJob) -> int:
    """What the checkpoints of a job that are there at once keep beside them."""
    experiment = job.experiment
    each = experiment.algo.kept_bytes(experiment.algo_config, job.spec, experiment.config.env_steps)
    return _CHECKPOINTS_AT_ONCE * len(job.seeds) * each
