"""Backends of asynchronous training: workers that compute contributions from their own rollouts."""

from collections import deque
from collections.abc import Sequence
from typing import Any

from headway.contracts import HeadwayError
from headway.contracts.acting_policy import Parameters
from headway.events import Row, Usage
from headway.rollout.collector import Evaluator, SerialBackend, close_all
from headway.rollout.plan import RolloutPlan, restart_purpose
from headway.rollout.workers.worker import Begin, Contribute, Done, WorkerService
from headway.rollout.workers.worker_pool import Notify, WorkerLauncher, WorkerPool, resume_command


class PoolContributors:
    """`Contributors` in a pool of workers, one per block of copies; `evaluator` evaluates.

    Workers do not wait for each other, even while the replacement of a worker that died repeats its rollout.
    """

    in_turns = False

    def __init__(
        self,
        plan: RolloutPlan,
        launcher: WorkerLauncher,
        notify: Notify,
        evaluator: Evaluator,
        timeout_s: float | None,
    ) -> None:
        self.plan, self.number, self.evaluator = plan, len(plan.block_shards), evaluator
        self.tasks: dict[int, Contribute] = {}
        self.ready: deque[int] = deque()
        """Workers that have answered, died or taken too long, until their answer is received, in order."""
        self.pool = WorkerPool(launcher, self.number, notify, plan.spec.name, timeout_s)
        self.pool.unfinished = self.tasks

    def begin(self) -> None:
        self.pool.all([Begin(self.plan.seed_purpose)] * self.number)

    def assign(self, worker: int, task: Contribute) -> None:
        self.tasks[worker] = task
        self.pool.send(worker, task)

    def next_done(self, turn: int | None) -> tuple[int, Contribute, Done]:
        """Wait for a contribution. A worker that dies is replaced and repeats it; the others continue."""
        while True:
            worker = self._next_ready() if turn is None else turn
            # Named by contribution, because a fast worker may fail in several contributions of one iteration.
            self.pool.restart_purpose = f"env restart for contribution {self.tasks[worker].number}"
            done = self.pool.receive(worker)
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

    def snapshot(self) -> list[Any]:
        """Return, per worker, its state before its current task, and that task."""
        states = [worker.snapshot for worker in self.pool.workers]
        return [_with_task(state, self.tasks.get(worker)) for worker, state in enumerate(states)]

    def restore(self, snapshots: list[Any], iteration: int) -> None:
        """Restore every worker and send it its task again; workers without a snapshot start new episodes."""
        _require_blocks(snapshots, self.plan)
        states = [None if snapshot is None else snapshot["worker"] for snapshot in snapshots]
        self.pool.all([resume_command(state, restart_purpose(iteration)) for state in states])
        for worker, task in _tasks_of(snapshots).items():
            self.assign(worker, task)

    def evaluate(self, root: int, episodes: int, greedy: bool, parameters: Parameters) -> list[list[Row]]:
        return self.evaluator.evaluate(root, episodes, greedy, parameters)

    def process_ids(self) -> list[int]:
        return self.pool.process_ids() + self.evaluator.process_ids()

    def usage(self) -> Usage:
        return self.pool.usage() + self.evaluator.usage()

    def close(self) -> None:
        close_all([self.pool, self.evaluator])


class SerialContributors(SerialBackend):
    """`Contributors` in the training process, one after another in a fixed order, for debugging and tests."""

    in_turns = True

    def __init__(self, plan: RolloutPlan, evaluator: Evaluator | None = None) -> None:
        super().__init__(plan, evaluator)
        self.tasks: dict[int, Contribute] = {}
        self.workers = [WorkerService(plan, shard) for shard in plan.block_shards]
        self.number = len(self.workers)

    def begin(self) -> None:
        for worker in self.workers:
            worker.execute(Begin(self.plan.seed_purpose))

    def assign(self, worker: int, task: Contribute) -> None:
        """Store the task of an idle worker until `next_done` executes it."""
        self.tasks[worker] = task

    def next_done(self, turn: int | None) -> tuple[int, Contribute, Done]:
        """Execute the task of the worker `turn`; None: the task that was assigned first."""
        worker = next(iter(self.tasks)) if turn is None else turn
        task = self.tasks.pop(worker)
        return worker, task, self.workers[worker].execute(task)

    def snapshot(self) -> list[Any]:
        """Return, per worker, its state and its next task."""
        states = [worker.snapshot() for worker in self.workers]
        return [_with_task(state, self.tasks.get(worker)) for worker, state in enumerate(states)]

    def restore(self, snapshots: list[Any], iteration: int) -> None:
        """Restore every worker and its task from a checkpoint of either backend."""
        _require_blocks(snapshots, self.plan)
        for worker, snapshot in zip(self.workers, snapshots, strict=True):
            state = None if snapshot is None else snapshot["worker"]
            worker.execute(resume_command(state, restart_purpose(iteration)))
        self.tasks = _tasks_of(snapshots)

    def close(self) -> None:
        close_all([*(worker.sampler.env for worker in self.workers), self.evaluator])


def _require_blocks(snapshots: Sequence[Any], plan: RolloutPlan) -> None:
    """Raise HeadwayError unless a checkpoint has one snapshot per worker, each of which has a block."""
    workers, number = len(snapshots), len(plan.block_shards)
    if workers != number:
        raise HeadwayError(
            f"the checkpoint was made with {workers} workers, not with {number}, and a worker "
            f'has a block of the copies; set "block" of "rollout" in the run\'s plan.json to '
            f"{plan.copies // max(workers, 1)}"
        )


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
