"""Backends of asynchronous training: workers that compute contributions from their own rollouts."""

from collections import deque
from collections.abc import Sequence
from typing import Any

from headway.contracts import HeadwayError
from headway.contracts.acting_policy import Parameters
from headway.events import Row, Usage
from headway.rollout.collector import Collector, concatenate_blocks, restart_purpose
from headway.rollout.episodes import EvaluationRequest, evaluate_policy
from headway.rollout.plan import copies_limit_text
from headway.rollout.workers.async_worker import AsynchronousPlan, ContributionService
from headway.rollout.workers.process_workers import process_collector
from headway.rollout.workers.worker import Begin, Contribute, Done, Restore
from headway.rollout.workers.worker_pool import Notify, WorkerLauncher, WorkerPool, resume_command


class PoolContributors:
    """Contributors in a pool of workers, one per block of copies.

    Workers do not wait for each other, even while the replacement of a worker that died repeats its rollout.
    A separate worker evaluates; `evaluate` waits for it.
    """

    in_turns = False

    def __init__(
        self,
        plan: AsynchronousPlan,
        launcher: WorkerLauncher,
        evaluator: Collector,
        notify: Notify,
        timeout_s: float | None = None,
    ) -> None:
        """`evaluator` never begins training episodes. It is closed with this object or if the start fails."""
        self.plan, self.evaluator = plan, evaluator
        self.tasks: dict[int, Contribute] = {}
        """Current task by worker."""
        self.ready: deque[int] = deque()
        """Workers that have answered, died or taken too long, until their answer is received, in order."""
        try:
            name = plan.rollout.spec.name
            self.pool = WorkerPool(launcher, len(plan.shards), notify, name, timeout_s)
        except BaseException:
            evaluator.close()
            raise

    @property
    def number(self) -> int:
        """Number of workers."""
        return len(self.pool.workers)

    def begin(self) -> None:
        """Start the first episodes."""
        self.pool.all([Begin("env")] * self.number)

    def idle(self) -> list[int]:
        """Return the workers without a task, in order."""
        return [worker for worker in range(self.number) if worker not in self.tasks]

    def assign(self, worker: int, task: Contribute) -> None:
        """Send a task to an idle worker."""
        self.tasks[worker] = task
        self.pool.send(worker, task)

    def next_done(self, turn: int | None) -> tuple[int, Contribute, Done]:
        """Wait for a contribution; return its worker, task and answer.

        `turn`: worker to wait for; None: whichever answers first. A worker that dies is replaced and repeats
        its contribution while the others continue.
        """
        while True:
            worker = self._next_ready() if turn is None else turn
            # Named by contribution, because a fast worker may fail in several contributions of one iteration.
            self.pool.restart_purpose = f"env restart for contribution {self.tasks[worker].number}"
            done = self.pool.receive(worker, self.tasks[worker])
            if done is not None:
                return worker, self.tasks.pop(worker), done

    def _next_ready(self) -> int:
        """Return the worker whose answer arrived first; wait for one if none has arrived."""
        while True:
            waiting = [worker for worker in self.tasks if worker not in self.ready]
            self.ready += self.pool.answered(waiting, 0 if self.ready else None)
            worker = self.ready.popleft()
            if self.pool.answered([worker], 0):  # else it was late, and its limit has grown since
                return worker

    def evaluate(self, root: int, episodes: int, greedy: bool, parameters: Parameters) -> list[list[Row]]:
        """Play evaluation episodes in the separate worker."""
        return self.evaluator.evaluate(root, episodes, greedy, parameters)

    def snapshot(self) -> list[Any]:
        """Return, per worker, its state before its current task, and that task."""
        states = [worker.snapshot for worker in self.pool.workers]
        return [_with_task(state, self.tasks.get(worker)) for worker, state in enumerate(states)]

    def restore(self, snapshots: list[Any], iteration: int) -> None:
        """Restore every worker and send it its task again; workers without a snapshot start new episodes."""
        self.plan.require_workers(snapshots)
        states = [None if snapshot is None else snapshot["worker"] for snapshot in snapshots]
        self.pool.all([resume_command(state, restart_purpose(iteration)) for state in states])
        for worker, task in _tasks_of(snapshots).items():
            self.assign(worker, task)

    def process_ids(self) -> list[int]:
        """Return the process ids of contributing and evaluating workers."""
        return self.pool.process_ids() + self.evaluator.process_ids()

    def usage(self) -> Usage:
        """Return the usage of all workers, current tasks included."""
        # The rollout of a busy worker may never be reported, as training ends without it.
        return self.pool.usage(self.tasks) + self.evaluator.usage()

    def close(self) -> None:
        """Kill busy workers, whose results are no longer needed, and end the others."""
        try:
            self.pool.close(killed=self.tasks)
        finally:
            self.evaluator.close()


class SerialContributors:
    """Contributors in the training process, one after another in a fixed order, for debugging and tests."""

    in_turns = True

    def __init__(self, plan: AsynchronousPlan, notify: Notify, timeout_s: float | None = None) -> None:
        self.asynchronous, self.plan = plan, plan.rollout
        limit = self.plan.spec.max_copies_per_process
        if limit is not None and self.plan.copies > limit:
            raise HeadwayError(
                f"{copies_limit_text(self.plan.spec, limit)}, and this one would hold "
                f"{self.plan.copies}; set backend=process, or rollout.copies={limit}"
            )
        self.workers = [ContributionService(plan, shard) for shard in plan.shards]
        self.tasks: dict[int, Contribute] = {}
        """Current task by worker, in order of assignment."""
        evaluation = self.plan.evaluation_plan
        self.evaluator = (
            None if limit is None else process_collector(evaluation, [evaluation.whole], notify, timeout_s)
        )
        """Separate evaluation process; None: evaluate in this process."""

    @property
    def number(self) -> int:
        """Number of workers."""
        return len(self.workers)

    def begin(self) -> None:
        """Start the first episodes."""
        for worker in self.workers:
            worker.execute(Begin("env"))

    def idle(self) -> list[int]:
        """Return the workers without a task, in order."""
        return [worker for worker in range(self.number) if worker not in self.tasks]

    def assign(self, worker: int, task: Contribute) -> None:
        """Store the task of an idle worker until `next_done` executes it."""
        self.tasks[worker] = task

    def next_done(self, turn: int | None) -> tuple[int, Contribute, Done]:
        """Execute a task; return its worker, task and answer.

        `turn`: worker whose task to execute; None: the one whose task was assigned first.
        """
        worker = next(iter(self.tasks)) if turn is None else turn
        task = self.tasks.pop(worker)
        return worker, task, self.workers[worker].execute(task)

    def evaluate(self, root: int, episodes: int, greedy: bool, parameters: Parameters) -> list[list[Row]]:
        """Play evaluation episodes, in a separate process if the environment limits copies per process."""
        if self.evaluator is not None:
            return self.evaluator.evaluate(root, episodes, greedy, parameters)
        requests = EvaluationRequest.split(root, episodes, greedy, self.plan.spec)
        return concatenate_blocks([evaluate_policy(self.plan, parameters, request) for request in requests])

    def snapshot(self) -> list[Any]:
        """Return, per worker, its state and its next task."""
        states = [worker.snapshot() for worker in self.workers]
        return [_with_task(state, self.tasks.get(worker)) for worker, state in enumerate(states)]

    def restore(self, snapshots: list[Any], iteration: int) -> None:
        """Restore every worker and its task from a checkpoint of either backend."""
        self.asynchronous.require_workers(snapshots)
        for worker, snapshot in zip(self.workers, snapshots, strict=True):
            restarts = snapshot is None
            worker.execute(Begin(restart_purpose(iteration)) if restarts else Restore(snapshot["worker"]))
        self.tasks = _tasks_of(snapshots)

    def process_ids(self) -> list[int]:
        """Return the id of the evaluation process, if there is one."""
        return [] if self.evaluator is None else self.evaluator.process_ids()

    def usage(self) -> Usage:
        """Return the usage of the evaluation process, if there is one."""
        return Usage() if self.evaluator is None else self.evaluator.usage()

    def close(self) -> None:
        """Close the environments and end the evaluation process."""
        for worker in self.workers:
            worker.sampler.env.close()
        if self.evaluator is not None:
            self.evaluator.close()


def _with_task(state: Any, task: Contribute | None) -> Any:  # noqa: ANN401 - opaque
    """Return a worker's checkpoint entry of plain values; None if the environment has no snapshots."""
    if state is None:
        return None
    plain = None if task is None else [task.number, task.updates, dict(task.published)]
    return {"worker": state, "task": plain}


def _tasks_of(snapshots: Sequence[Any]) -> dict[int, Contribute]:
    """Return the stored task of each worker, by contribution number."""
    stored = {w: snapshot["task"] for w, snapshot in enumerate(snapshots) if snapshot and snapshot["task"]}
    return {w: Contribute(*stored[w]) for w in sorted(stored, key=lambda worker: (stored[worker][0], worker))}
