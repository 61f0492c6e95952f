"""Choice of the backend. All of them produce the same trajectory, bit for bit."""

from collections.abc import Sequence

from headway.config.experiment import BackendConfig
from headway.rollout.async_collector import PoolContributors, SerialContributors
from headway.rollout.collector import Backend, Collector, Contributors
from headway.rollout.plan import RolloutPlan, Shard
from headway.rollout.pool_collector import PoolCollector
from headway.rollout.serial_collector import SerialCollector
from headway.rollout.workers.process_workers import ProcessLauncher
from headway.rollout.workers.worker_pool import Notify, WorkerLauncher


def open_collector(backend: BackendConfig, plan: RolloutPlan, workers: int, notify: Notify) -> Collector:
    """Start the configured backend of synchronous training.

    If the environment limits the copies per process, evaluation gets separate workers, with the serial
    backend too. Raises HeadwayError if the backend cannot start.
    """
    shards = [plan.whole] if backend.name == "serial" else plan.shards(workers)
    collector = _open(backend.name, backend, plan, shards, notify)
    if plan.spec.max_copies_per_process is not None:
        _add_evaluator(collector, backend, workers, notify)
    return collector


def open_contributors(backend: BackendConfig, plan: RolloutPlan, notify: Notify) -> Contributors:
    """Start the configured backend of asynchronous training, with a separate worker for evaluation.

    The serial backend needs that only if the environment limits the copies per process. Raises HeadwayError
    if the backend cannot start.
    """
    contributors: Contributors
    if backend.name == "serial":
        contributors = SerialContributors(plan)
    else:
        shards = plan.block_shards
        launcher = _launcher(backend.name, backend, plan, shards, notify)
        contributors = PoolContributors(plan, launcher, len(shards), notify, backend.worker_timeout_s)
    if backend.name != "serial" or plan.spec.max_copies_per_process is not None:
        _add_evaluator(contributors, backend, contributors.number, notify)
    return contributors


def _add_evaluator(owner: Backend, backend: BackendConfig, workers: int, notify: Notify) -> None:
    """Start workers that only evaluate for `owner`, which is closed if they cannot start.

    There are as many as one replica group has for training, because cores are reserved for one group only,
    and at most one per group.
    """
    plan, name = owner.plan, "process" if backend.name == "serial" else backend.name
    groups = len(plan.groups)
    evaluation, number = plan.evaluation_plan, min(groups, max(1, workers // groups))
    if name == "ray" and backend.cpus_per_worker:
        number = 1  # an evaluation worker occupies its CPUs of the cluster during training too
    try:
        # Evaluation tasks name their replicas, so the shard of an evaluation worker is never used.
        owner.evaluator = _open(name, backend, evaluation, [evaluation.whole] * number, notify)
    except BaseException:
        owner.close()
        raise


def _open(
    name: str, backend: BackendConfig, plan: RolloutPlan, shards: Sequence[Shard], notify: Notify
) -> Collector:
    """Start the collector of the backend `name`, which may differ from that of `backend`."""
    if name == "serial":
        return SerialCollector(plan)
    launcher = _launcher(name, backend, plan, shards, notify)
    return PoolCollector(plan, launcher, len(shards), notify, backend.worker_timeout_s)


def _launcher(
    name: str, backend: BackendConfig, plan: RolloutPlan, shards: Sequence[Shard], notify: Notify
) -> WorkerLauncher:
    """Return the launcher of the workers of a backend, in processes or on a Ray cluster."""
    if name == "process":
        return ProcessLauncher(plan, shards)
    from headway.rollout.workers.ray_workers import RayLauncher  # imports Ray, an optional extra

    return RayLauncher(backend, plan, shards, notify)
