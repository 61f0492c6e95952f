"""How a session's jobs share the cores and GPUs of a machine or cluster."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from headway.config.experiment import BackendConfig
from headway.training.loop import TrainingJob
from headway_launch.runner.jobs import PlannedJob


@dataclass(frozen=True)
class CoreShares:
    """How the cores are shared among training processes."""

    parallel: int
    """Training processes at once."""
    workers: int
    """Rollout workers of each training process whose number of workers is not fixed."""


def share_cores(
    backend: BackendConfig,
    jobs: Sequence[PlannedJob],
    cores: int,
    cluster_cpus: int | None = None,
    node_cpus: int | None = None,
) -> CoreShares:
    """Return how many training processes run at once, and how many rollout workers each has.

    At most one training process runs per core and per job. The workers share the cores, or the cluster's CPUs
    if they run on a cluster. Jobs with a fixed number of workers run in parallel as far as the cores suffice:
    on a cluster each worker needs a CPU, otherwise a job needs `cores_taken`. `node_cpus`: upper limit per
    job if `cores` are spread over several machines.
    """
    fixed = [(job, _fixed_workers(job) or 1) for job in jobs]
    if cluster_cpus is None:
        most = max([1, *(cores_taken(job.training, workers, node_cpus) for job, workers in fixed)])
    else:
        most = max([1, *(workers for _, workers in fixed)])
    for_workers = cores if cluster_cpus is None else cluster_cpus
    at_once = max(1, min(cores, for_workers // most))
    parallel = max(1, min(backend.parallel or at_once, len(jobs)))
    workers = max(1, for_workers // parallel)
    return CoreShares(parallel, workers if node_cpus is None else min(workers, node_cpus))


def cores_taken(job: TrainingJob, workers: int, node_cpus: int | None) -> int:
    """Return the number of cores to reserve for a training process and its workers.

    It is one per worker, since the workers alternate with the learner, and at most `node_cpus`. If the
    replicas of a stack are split over worker groups, only one group counts: the learner's work grows with the
    number of groups, and counting all of them would leave cores idle while it learns.
    """
    taken = max(1, workers // len(job.plan.groups))
    return taken if node_cpus is None else min(taken, node_cpus)


def workers_of(job: PlannedJob, shares: CoreShares) -> int:
    """Return the number of rollout workers of a job.

    It is the number in its checkpoint, else the configured one, else the job's share of the cores. A new job
    never has more workers than blocks.
    """
    return _fixed_workers(job) or min(shares.workers, _most_workers(job))


def _fixed_workers(job: PlannedJob) -> int | None:
    """Return the number of rollout workers if it does not depend on the cores, else None."""
    if job.workers is not None:
        return job.workers
    backend = job.config.backend
    if backend.name == "serial":
        return 1
    return None if backend.workers is None else min(backend.workers, _most_workers(job))


def _most_workers(job: PlannedJob) -> int:
    """Return the maximum useful number of workers: one per block of copies and worker group."""
    plan = job.training.plan
    return len(plan.groups) * (plan.copies // plan.block)


def gpus_of(device: str, available: float) -> float:
    """Return the GPUs that a training process requests from a cluster with `available` GPUs.

    One for `cuda`, one for `auto` if the cluster has any, else none.
    """
    return 1.0 if device.startswith("cuda") or (device == "auto" and available >= 1.0) else 0.0


def uses_gpu(job: PlannedJob) -> bool:
    """Return whether a job trains on a GPU."""
    device = job.config.device
    return device.startswith("cuda") or (device == "auto" and Path("/dev/nvidiactl").exists())
