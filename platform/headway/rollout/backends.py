"""Backends by name. Every one gives the same trajectory bit for bit."""

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
    """The backend of that name, with its workers started. Where a process may hold few copies, which
    training needs, evaluation has workers of its own, beside the serial backend too.

    Raises HeadwayError where it cannot be had.
    """
    shards = [plan.whole] if backend.name == "serial" else plan.shards(workers)
    collector = _COLLECTORS[backend.name](backend, plan, shards, notify)
    if plan.spec.max_copies_per_process is None:
        return collector
    try:
        return SeparateEvaluation(collector, _evaluating(backend, plan, workers, notify))
    except BaseException:
        collector.close()
        raise


def open_contributors(backend: BackendConfig, plan: AsynchronousPlan, notify: Notify) -> Contributors:
    """The same for the asynchronous mode."""
    if backend.name == "serial":
        return SerialContributors(plan, notify)
    evaluating = _evaluating(backend, plan.rollout, len(plan.shards), notify)
    try:
        launcher = _LAUNCHERS[backend.name](backend, plan, notify)
    except BaseException:
        evaluating.close()
        raise
    return PoolContributors(plan, launcher, evaluating, notify)


def _evaluating(backend: BackendConfig, plan: RolloutPlan, workers: int, notify: Notify) -> Collector:
    """Workers that only evaluate: one, or, where training has the replicas in groups, as many as one group
    has for training, since a stack counts for so many cores where several trainings share a machine."""
    name = "process" if backend.name == "serial" else backend.name
    groups = len(plan.groups)
    apart, number = plan.evaluation_plan, min(groups, max(1, workers // groups))
    if name == "ray" and backend.cpus_per_worker:
        number = 1  # each would keep its place in the cluster while training goes on
    # Whoever only evaluates may be told to for any replicas: its shard is never used.
    return _COLLECTORS[name](backend, apart, [apart.whole] * number, notify)


def _serial(backend: BackendConfig, plan: RolloutPlan, shards: Sequence[Shard], notify: Notify) -> Collector:
    return SerialCollector(plan)


def _process(backend: BackendConfig, plan: RolloutPlan, shards: Sequence[Shard], notify: Notify) -> Collector:
    return process_collector(plan, shards, notify)


def _ray(backend: BackendConfig, plan: RolloutPlan, shards: Sequence[Shard], notify: Notify) -> Collector:
    from headway.rollout.workers.ray_workers import ray_collector  # which imports Ray, an extra

    return ray_collector(backend, plan, shards, notify)


def _processes(backend: BackendConfig, plan: AsynchronousPlan, notify: Notify) -> WorkerLauncher:
    pickled = SharedPickle.of(plan)
    setups = [ContributorSetup(pickled, shard) for shard in plan.shards]
    return ProcessLauncher(setups, [*plan.rollout.preload, *plan.preload], pickled)


def _actors(backend: BackendConfig, plan: AsynchronousPlan, notify: Notify) -> WorkerLauncher:
    from headway.rollout.workers.ray_workers import RayLauncher, pickled_whole

    pickled = pickled_whole(plan)
    setups = [ContributorSetup(pickled, shard) for shard in plan.shards]
    return RayLauncher(backend, setups, notify)


_COLLECTORS: Mapping[str, Callable[[BackendConfig, RolloutPlan, Sequence[Shard], Notify], Collector]] = {
    "serial": _serial,
    "process": _process,
    "ray": _ray,
}
_LAUNCHERS: Mapping[str, Callable[[BackendConfig, AsynchronousPlan, Notify], WorkerLauncher]] = {
    "process": _processes,
    "ray": _actors,
}
