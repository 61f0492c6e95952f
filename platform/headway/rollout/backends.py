"""Backends by name. Every one gives the same trajectory bit for bit."""

from collections.abc import Callable, Mapping

from headway.rollout.apart import EvaluatingApart
from headway.rollout.collecting import Collector
from headway.rollout.plan import RolloutPlan
from headway.rollout.processes import Notify, ProcessCollector
from headway.rollout.serial import SerialCollector


def open_collector(name: str, plan: RolloutPlan, workers: int, notify: Notify) -> Collector:
    """The backend of that name, with its workers started. Where a process may hold few copies, which
    training needs, evaluation has a worker of its own, beside the serial backend too."""
    collector = BACKENDS[name](plan, workers, notify)
    if plan.spec.max_copies_per_process is None:
        return collector
    try:
        return EvaluatingApart(collector, ProcessCollector(plan.evaluating_apart, 1, notify))
    except BaseException:
        collector.close()
        raise


BACKENDS: Mapping[str, Callable[[RolloutPlan, int, Notify], Collector]] = {
    "serial": lambda plan, workers, notify: SerialCollector(plan),
    "process": ProcessCollector,
}
