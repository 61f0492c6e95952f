"""Registry of the backends. All of them produce the same trajectory, bit for bit."""

from collections.abc import Callable, Mapping, Sequence

from headway.config.experiment import BackendConfig
from headway.rollout.async_collector import PoolContributors, SerialContributors
from headway.rollout.collector import Collector, Contributors
from headway.rollout.plan import RolloutPlan, Shard
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
    collector = _COLLECTORS[backend.name](backend, plan, shards, notify)
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
        return SerialContributors(plan, notify)
    evaluator = _open_evaluator(backend, plan.rollout, len(plan.shards), notify)
    try:
        launcher = _LAUNCHERS[backend.name](backend, plan, notify)
    except BaseException:
        evaluator.close()
        raise
    return PoolContributors(plan, launcher, evaluator, notify)


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
    return _COLLECTORS[name](backend, evaluation, [evaluation.whole] * number, notify)


def _serial_collector(
    backend: BackendConfig, plan: RolloutPlan, shards: Sequence[Shard], notify: Notify
) -> Collector:
    return SerialCollector(plan)


def _process_collector(
    backend: BackendConfig, plan: RolloutPlan, shards: Sequence[Shard], notify: Notify
) -> Collector:
    return process_collector(plan, shards, notify)


def _ray_collector(
    backend: BackendConfig, plan: RolloutPlan, shards: Sequence[Shard], notify: Notify
) -> Collector:
    from headway.rollout.workers.ray_workers import ray_collector  # imports Ray, an optional extra

    return ray_collector(backend, plan, shards, notify)


def _process_launcher(backend: BackendConfig, plan: AsynchronousPlan, notify: Notify) -> WorkerLauncher:
    pickled = SharedPickle.of(plan)
    setups = [ContributorSetup(pickled, shard) for shard in plan.shards]
    return ProcessLauncher(setups, [*plan.rollout.preload, *plan.preload], pickled)


def _ray_launcher(backend: BackendConfig, plan: AsynchronousPlan, notify: Notify) -> WorkerLauncher:
    from headway.rollout.workers.ray_workers import RayLauncher, pickled_whole

    pickled = pickled_whole(plan)
    setups = [ContributorSetup(pickled, shard) for shard in plan.shards]
    return RayLauncher(backend, setups, notify)


_COLLECTORS: Mapping[str, Callable[[BackendConfig, RolloutPlan, Sequence[Shard], Notify], Collector]] = {
    "serial": _serial_collector,
    "process": _process_collector,
    "ray": _ray_collector,
}
_LAUNCHERS: Mapping[str, Callable[[BackendConfig, AsynchronousPlan, Notify], WorkerLauncher]] = {
    "process": _process_launcher,
    "ray": _ray_launcher,
}
