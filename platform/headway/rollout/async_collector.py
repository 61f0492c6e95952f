"""Backends of the asynchronous mode: workers that learn from their own rollouts. While they do, evaluation
has a place of its own."""

from collections import deque
from collections.abc import Sequence
from typing import Any

from headway.contracts import HeadwayError
from headway.contracts.acting_policy import Parameters
from headway.events import Row, Usage
from headway.rollout.collector import Collector, evaluation_requests, concatenate_blocks, restart_purpose
from headway.rollout.episodes import evaluate_policy
from headway.rollout.plan import process_holds
from headway.rollout.workers.async_worker import AsynchronousPlan, ContributionService
from headway.rollout.workers.process_workers import process_collector
from headway.rollout.workers.worker import Begin, Contribute, Done, Restore
from headway.rollout.workers.worker_pool import Notify, WorkerLauncher, WorkerPool, resume_command


class PoolContributors:
    """Workers of a crew, one a block of copies. They go on with what they do whatever the others do, also
    where one died and its replacement repeats its rollout. Evaluation is one worker's work, and whoever
    asks for it waits."""

    in_turns = False

    def __init__(
        self, plan: AsynchronousPlan, launcher: WorkerLauncher, evaluating: Collector, notify: Notify
    ) -> None:
        """`evaluating`: is never begun; this closes it, also where it cannot start."""
        self.plan, self.evaluating = plan, evaluating
        self.tasks: dict[int, Contribute] = {}
        self.arrived: deque[int] = deque()
        """Workers that have answered, or died, and were not heard yet; first come, first heard."""
        try:
            self.pool = WorkerPool(launcher, len(plan.shards), notify)
        except BaseException:
            evaluating.close()
            raise

    @property
    def number(self) -> int:
        """See `Contributors`."""
        return len(self.pool.workers)

    def begin(self) -> None:
        """Start the first episodes."""
        self.pool.all([Begin("env")] * self.number)

    def idle(self) -> list[int]:
        """See `Contributors`."""
        return [worker for worker in range(self.number) if worker not in self.tasks]

    def assign(self, worker: int, task: Contribute) -> None:
        """See `Contributors`."""
        self.tasks[worker] = task
        self.pool.send(worker, task)

    def next_done(self, turn: int | None) -> tuple[int, Contribute, Done]:
        """See `Contributors`; a worker that died is replaced, and contributes again while others go on."""
        while True:
            worker = self._first_come() if turn is None else turn
            # By the contribution, as a fast worker makes, and may die in, several of one iteration.
            self.pool.anew = f"env restart for contribution {self.tasks[worker].number}"
            done = self.pool.hear(worker, self.tasks[worker])
            if done is not None:
                return worker, self.tasks.pop(worker), done

    def _first_come(self) -> int:
        unheard = [worker for worker in self.tasks if worker not in self.arrived]
        self.arrived += self.pool.answered(unheard, 0 if self.arrived else None)
        return self.arrived.popleft()

    def evaluate(self, root: int, episodes: int, greedy: bool, parameters: Parameters) -> list[list[Row]]:
        """Evaluation episodes, by a worker of its own."""
        return self.evaluating.evaluate(root, episodes, greedy, parameters)

    def snapshot(self) -> list[Any]:
        """Of each worker: where it stood before what it does now, and what that is."""
        states = [worker.snapshot for worker in self.pool.workers]
        return [_with_task(state, self.tasks.get(worker)) for worker, state in enumerate(states)]

    def restore(self, snapshots: list[Any], iteration: int) -> None:
        """Have everyone begin again with what it was doing; where there are no snapshots, start anew."""
        self.plan.require_workers(snapshots)
        states = [None if snapshot is None else snapshot["worker"] for snapshot in snapshots]
        self.pool.all([resume_command(state, restart_purpose(iteration)) for state in states])
        for worker, task in _tasks_of(snapshots).items():
            self.assign(worker, task)

    def process_ids(self) -> list[int]:
        """Of all workers."""
        return self.pool.process_ids() + self.evaluating.process_ids()

    def usage(self) -> Usage:
        """Of all workers, with what they do now: a rollout under way may never be heard of."""
        return self.pool.usage(self.tasks) + self.evaluating.usage()

    def close(self) -> None:
        """End all workers: at once, as nobody waits for what they are doing."""
        try:
            self.pool.close(hastily=self.tasks)
        finally:
            self.evaluating.close()


class SerialContributors:
    """Workers that the training process plays itself, always in turns: for debugging and tests."""

    in_turns = True

    def __init__(self, plan: AsynchronousPlan, notify: Notify) -> None:
        self.asynchronous, self.plan = plan, plan.rollout
        limit = self.plan.spec.max_copies_per_process
        if limit is not None and self.plan.copies > limit:
            raise HeadwayError(
                f"{process_holds(self.plan.spec, limit)}, and this one would hold "
                f"{self.plan.copies}; set backend=process, or rollout.copies={limit}"
            )
        self.workers = [ContributionService(plan, shard) for shard in plan.shards]
        self.tasks: dict[int, Contribute] = {}
        apart = self.plan.evaluation_plan
        self.apart = None if limit is None else process_collector(apart, [apart.whole], notify)

    @property
    def number(self) -> int:
        """See `Contributors`."""
        return len(self.workers)

    def begin(self) -> None:
        """Start the first episodes."""
        for worker in self.workers:
            worker.execute(Begin("env"))

    def idle(self) -> list[int]:
        """See `Contributors`."""
        return [worker for worker in range(self.number) if worker not in self.tasks]

    def assign(self, worker: int, task: Contribute) -> None:
        """See `Contributors`."""
        self.tasks[worker] = task

    def next_done(self, turn: int | None) -> tuple[int, Contribute, Done]:
        """See `Contributors`; what comes first is what was assigned first."""
        worker = next(iter(self.tasks)) if turn is None else turn
        task = self.tasks.pop(worker)
        return worker, task, self.workers[worker].execute(task)

    def evaluate(self, root: int, episodes: int, greedy: bool, parameters: Parameters) -> list[list[Row]]:
        """Evaluation episodes, here or, where a process may hold few copies, in one of its own."""
        if self.apart is not None:
            return self.apart.evaluate(root, episodes, greedy, parameters)
        requests = evaluation_requests(self.plan, root, episodes, greedy)
        return concatenate_blocks([evaluate_policy(self.plan, parameters, request) for request in requests])

    def snapshot(self) -> list[Any]:
        """Of each worker: where it stands, and what it is to do next."""
        states = [worker.snapshot() for worker in self.workers]
        return [_with_task(state, self.tasks.get(worker)) for worker, state in enumerate(states)]

    def restore(self, snapshots: list[Any], iteration: int) -> None:
        """As for processes, which may have made the checkpoint."""
        self.asynchronous.require_workers(snapshots)
        for worker, snapshot in zip(self.workers, snapshots, strict=True):
            anew = snapshot is None
            worker.execute(Begin(restart_purpose(iteration)) if anew else Restore(snapshot["worker"]))
        self.tasks = _tasks_of(snapshots)

    def process_ids(self) -> list[int]:
        """None but evaluation's, if it has one."""
        return [] if self.apart is None else self.apart.process_ids()

    def usage(self) -> Usage:
        """Nothing beside this process but evaluation's."""
        return Usage() if self.apart is None else self.apart.usage()

    def close(self) -> None:
        """Close the environments."""
        for worker in self.workers:
            worker.sampler.env.close()
        if self.apart is not None:
            self.apart.close()


def _with_task(state: Any, task: Contribute | None) -> Any:  # noqa: ANN401 - opaque
    """For a checkpoint, which holds plain values; None where the environment keeps no snapshots."""
    if state is None:
        return None
    plain = None if task is None else [task.number, task.updates, dict(task.published)]
    return {"worker": state, "task": plain}


def _tasks_of(snapshots: Sequence[Any]) -> dict[int, Contribute]:
    """What workers were doing, by worker, the earliest begun first."""
    told = {w: snapshot["task"] for w, snapshot in enumerate(snapshots) if snapshot and snapshot["task"]}
    return {w: Contribute(*told[w]) for w in sorted(told, key=lambda worker: (told[worker][0], worker))}
