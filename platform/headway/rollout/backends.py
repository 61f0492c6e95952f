"""Choice of the backend. All of them produce the same trajectory, bit for bit."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from headway.config.experiment import BackendConfig
from headway.rollout.async_collector import PoolContributors, SerialContributors
from headway.rollout.collector import Collector, Contributors, Evaluator
from headway.rollout.plan import RolloutPlan, Shard
from headway.rollout.pool_collector import PoolCollector, SamplingLauncher
from headway.rollout.serial_collector import SerialCollector
from headway.rollout.workers.process_workers import ProcessLauncher, SamplingProcessLauncher
from headway.rollout.workers.worker_pool import Notify, WorkerLauncher


def open_collector(backend: BackendConfig, plan: RolloutPlan, workers: int, notify: Notify) -> Collector:
    """Start the configured backend of synchronous training.

    If the environment limits the copies per process, evaluation gets separate workers, with the serial
    backend too. Raises HeadwayError if the backend cannot start.
    """
    shards = [plan.whole] if backend.name == "serial" else plan.shards(workers)
    if plan.spec.max_copies_per_process is None:
        return _open(backend.name, backend, plan, shards, notify)
    with _evaluator(backend, plan, workers, notify) as evaluator:
        return _open(backend.name, backend, plan, shards, notify, evaluator)


def open_contributors(backend: BackendConfig, plan: RolloutPlan, notify: Notify) -> Contributors:
    """Start the configured backend of asynchronous training, with a separate worker for evaluation.

    The serial backend needs that only if the environment limits the copies per process. Raises HeadwayError
    if the backend cannot start.
    """
    shards = plan.block_shards
    if backend.name == "serial" and plan.spec.max_copies_per_process is None:
        return SerialContributors(plan)
    with _evaluator(backend, plan, len(shards), notify) as evaluator:
        if backend.name == "serial":
            return SerialContributors(plan, evaluator)
        launcher: WorkerLauncher
        if backend.name == "process":
            launcher = ProcessLauncher(plan, shards)
        else:
            from headway.rollout.workers.ray_workers import RayLauncher  # imports Ray, an optional extra

            launcher = RayLauncher(backend, plan, shards, notify)
        return PoolContributors(plan, launcher, notify, evaluator, backend.worker_timeout_s)


@contextmanager
def _evaluator(
    backend: BackendConfig, plan: RolloutPlan, workers: int, notify: Notify
) -> Iterator[Evaluator]:
    """Start workers that only evaluate, for a backend with `workers`; close them if that cannot start.

    There are as many as one replica group has for training, because cores are reserved for one group only,
    and at most one per group.
    """
    name, groups = "process" if backend.name == "serial" else backend.name, len(plan.groups)
    evaluation, number = plan.evaluation_plan, min(groups, max(1, workers // groups))
    if name == "ray" and backend.cpus_per_worker:
        number = 1  # an evaluation worker occupies its CPUs of the cluster during training too
    # Evaluation tasks name their replicas, so the shard of an evaluation worker is never used.
    evaluator = _open(name, backend, evaluation, [evaluation.whole] * number, notify)
    try:
        yield evaluator
    except BaseException:
        evaluator.close()
        raise


def _open(
    name: str,
    backend: BackendConfig,
    plan: RolloutPlan,
    shards: Sequence[Shard],
    notify: Notify,
    evaluator: Evaluator | None = None,
) -> Collector:
    """Start the collector of the backend `name`, which may differ from that of `backend`."""
    if name == "serial":
        return SerialCollector(plan, evaluator)
    launcher: SamplingLauncher
    if name == "process":
        launcher = SamplingProcessLauncher(plan, shards)
    else:
        from headway.rollout.workers.ray_workers import SamplingRayLauncher  # imports Ray, an optional extra

        launcher = SamplingRayLauncher(backend, plan, shards, notify)
    return PoolCollector(plan, launcher, len(shards), notify, backend.worker_timeout_s, evaluator)
