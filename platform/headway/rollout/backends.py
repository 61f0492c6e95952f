"""Choice of the backend. All of them produce the same trajectory, bit for bit."""

from collections.abc import Sequence

from headway.config.experiment import BackendConfig
from headway.rollout.async_collector import PoolContributors, SerialContributors
from headway.rollout.collector import Collector, Contributors
from headway.rollout.plan import RolloutPlan, Shard
from headway.rollout.pool_collector import PoolCollector
from headway.rollout.separate_evaluation import SeparateEvaluation
from headway.rollout.serial_collector import SerialCollector
from headway.rollout.workers.async_worker import AsynchronousPlan, ContributorSetup
from headway.rollout.workers.process_workers import ProcessLauncher, process_collector
from headway.rollout.workers.shared_memory import SharedPickle
from headway.rollout.workers.worker_pool import Notify, WorkerLauncher


def open_collector(backend: BackendConfig, plan: RolloutPlan, workers: int, notify: Notify) -> Collector:
    """Start the configured backend of synchronous training.

    If the environment limits the copies per process, evaluation gets separate workers, with the serial
    backend too. Raises HeadwayError if the backend cannot start.
    """
    shards = [plan.whole] if backend.name == "serial" else plan.shards(workers)
    collector = _open(backend.name, backend, plan, shards, notify)
    if plan.spec.max_copies_per_process is None:
        return collector
    try:
        return SeparateEvaluation(collector, _open_evaluator(backend, plan, workers, notify))
    except BaseException:
        collector.close()
        raise


def open_contributors(backend: BackendConfig, plan: AsynchronousPlan, notify: Notify) -> Contributors:
    """Start the configured backend of asynchronous training, with a separate worker for evaluation.

    Raises HeadwayError if the backend cannot start.
    """
    if backend.name == "serial":
        return SerialContributors(plan, notify, backend.worker_timeout_s)
    evaluator = _open_evaluator(backend, plan.rollout, len(plan.shards), notify)
    try:
        launcher = _launcher(backend, plan, notify)
    except BaseException:
        evaluator.close()
        raise
    return PoolContributors(plan, launcher, evaluator, notify, backend.worker_timeout_s)


def _open_evaluator(backend: BackendConfig, plan: RolloutPlan, workers: int, notify: Notify) -> Collector:
    """Start the workers that only evaluate.

    There are as many as one replica group has for training, because cores are reserved for one group only,
    and at most one per group.
    """
    name = "process" if backend.name == "serial" else backend.name
    groups = len(plan.groups)
    evaluation, number = plan.evaluation_plan, min(groups, max(1, workers // groups))
    if name == "ray" and backend.cpus_per_worker:
        number = 1  # an evaluation worker occupies its CPUs of the cluster during training too
    # Evaluation tasks name their replicas, so the shard of an evaluation worker is never used.
    return _open(name, backend, evaluation, [evaluation.whole] * number, notify)


def _open(
    name: str, backend: BackendConfig, plan: RolloutPlan, shards: Sequence[Shard], notify: Notify
) -> Collector:
    """Start the collector of the backend `name`, which may differ from that of `backend`."""
    if name == "serial":
        return SerialCollector(plan)
    if name == "process":
        return process_collector(plan, shards, notify, backend.worker_timeout_s)
    from headway.rollout.workers.ray_workers import RaySamplingTransport  # imports Ray, an optional extra

    transport = RaySamplingTransport(backend, plan, shards, notify)
    return PoolCollector(plan, transport, len(shards), notify, backend.worker_timeout_s)


def _launcher(backend: BackendConfig, plan: AsynchronousPlan, notify: Notify) -> WorkerLauncher:
    """Return the launcher of contributing workers, in processes or on a Ray cluster."""
    if backend.name == "process":
        shared = SharedPickle.of(plan)
        setups = [ContributorSetup(shared, shard) for shard in plan.shards]
        return ProcessLauncher(setups, [*plan.rollout.preload, *plan.preload], shared)
    from headway.rollout.workers.ray_workers import RayLauncher, pickled_whole

    pickled = pickled_whole(plan)
    return RayLauncher(backend, [ContributorSetup(pickled, shard) for shard in plan.shards], notify)
