"""Rollouts in worker processes, which are replaced when they die."""

import multiprocessing
import pickle
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field, replace
from multiprocessing import connection
from multiprocessing.context import ForkServerProcess
from typing import Any

from headway.contracts import HeadwayError, Trajectory
from headway.contracts.acting import Parameters
from headway.events import Row, Usage
from headway.rollout.collecting import evaluation_requests, joined, require_shards, restart_purpose
from headway.rollout.memory import SharedBlock
from headway.rollout.plan import RolloutPlan
from headway.rollout.sampler import Episode, in_order
from headway.rollout.usage import cpu_seconds_of
from headway.rollout.worker import (
    Begin,
    Broken,
    Collect,
    Command,
    Done,
    Evaluate,
    Restore,
    Setup,
    WorkerSetup,
    parameter_arrays,
    parameter_bytes,
    run_worker,
)

Notify = Callable[[str], None]

GRACE_S = 5.0
"""How long workers that are told to end may finish what they do, and that hung up may take to die."""


@dataclass
class _Worker:
    """A worker process and what is known of it."""

    process: ForkServerProcess
    pipe: connection.Connection
    begun: bool = False
    """Its episodes have started."""
    snapshot: Any = None
    """Where it stood after its last command that moved it."""
    usage: Usage = field(default_factory=Usage)
    repeats: list[Command] = field(default_factory=list)
    """What it has yet to carry out in place of one that failed; the first is under way."""

    def remember(self, command: Command, done: Done) -> None:
        """Note what it says of itself after a command."""
        self.note_cpu_seconds(done.usage.cpu_seconds)
        self.usage = replace(done.usage, cpu_seconds=self.usage.cpu_seconds)
        if not isinstance(command, Evaluate):
            self.begun, self.snapshot = True, done.snapshot

    def note_cpu_seconds(self, cpu_seconds: float) -> None:
        """What it has used as somebody sees it: never less than before."""
        self.usage = replace(self.usage, cpu_seconds=max(self.usage.cpu_seconds, cpu_seconds))


class ProcessCollector:
    """Worker processes that write into one shared trajectory and read one shared set of parameters."""

    def __init__(self, plan: RolloutPlan, workers: int, notify: Notify) -> None:
        self.plan = plan
        shards, pickled = plan.shards(workers), pickle.dumps(plan)
        shapes = plan.policy.parameter_shapes(plan.replicas)
        self.blocks = SharedBlock.create(plan.layout.nbytes), SharedBlock.create(parameter_bytes(shapes))
        self.trajectory = Trajectory.over(self.blocks[0].buffer, plan.layout)
        self.parameters = parameter_arrays(shapes, self.blocks[1].buffer)
        setups = [WorkerSetup(pickled, first, count, *self.blocks) for first, count in shards]
        self.crew = Crew(setups, plan.preload, b"_main__" in pickled, notify)

    def begin(self) -> None:
        """Start the first episodes."""
        self.crew.all([Begin("env")] * len(self.crew.workers))

    def collect(self, iteration: int, parameters: Parameters) -> list[Episode]:
        """Sample one iteration in all workers at once; a worker that dies is replaced and samples again."""
        self._publish(parameters)
        done = self.crew.all([Collect(iteration)] * len(self.crew.workers))
        self.crew.anew = restart_purpose(iteration)
        return in_order(episode for part in done for episode in part.episodes)

    def evaluate(self, root: int, episodes: int, greedy: bool, parameters: Parameters) -> list[list[Row]]:
        """Evaluation episodes, blocks dealt out to the workers in turn."""
        self._publish(parameters)
        requests = evaluation_requests(self.plan, root, episodes, greedy)
        parts: list[list[list[Row]]] = []
        for start in range(0, len(requests), len(self.crew.workers)):
            round_ = requests[start : start + len(self.crew.workers)]
            parts += [done.evaluation for done in self.crew.all([Evaluate(request) for request in round_])]
        return joined(self.plan, parts)

    def snapshot(self) -> list[Any]:
        """One a worker, as of the end of the last iteration."""
        return [worker.snapshot for worker in self.crew.workers]

    def restore(self, snapshots: list[Any], iteration: int) -> None:
        """Go on from a checkpoint, or start afresh where it holds no snapshots."""
        require_shards(snapshots, len(self.crew.workers))
        self.crew.anew = restart_purpose(iteration)
        self.crew.all([standing(snapshot, self.crew.anew) for snapshot in snapshots])

    def process_ids(self) -> list[int]:
        """Worker processes, by id."""
        return self.crew.process_ids()

    def usage(self) -> Usage:
        """As the workers last reported."""
        return self.crew.usage()

    def close(self) -> None:
        """End the workers, busy ones after some seconds of grace."""
        self.crew.close()
        for block in self.blocks:
            block.close()

    def _publish(self, parameters: Parameters) -> None:
        for name, array in self.parameters.items():
            array[...] = parameters[name]


class Crew:
    """Worker processes, each with a part of its own, that carry out commands and are replaced when they
    die."""

    def __init__(
        self, setups: Sequence[Setup], preload: Sequence[str], needs_main: bool, notify: Notify
    ) -> None:
        """`preload`: modules that they share; `needs_main`: what they are given refers to the main module."""
        self.setups, self.needs_main, self.notify = setups, needs_main, notify
        self.context = multiprocessing.get_context("forkserver")
        self.context.set_forkserver_preload(["headway.rollout.worker", *preload])
        self.lost_cpu_seconds = 0.0
        self.anew = restart_purpose(0)
        """Purpose of the seeds of episodes that start anew because their worker died."""
        self.workers = [self._start(shard) for shard in range(len(setups))]

    def all(self, commands: Sequence[Command]) -> list[Done]:
        """Have workers 0, 1, ... carry out one command each, at the same time."""
        for shard, command in enumerate(commands):
            self.send(shard, command)
        return [self.answer(shard, command) for shard, command in enumerate(commands)]

    def send(self, shard: int, command: Command) -> None:
        """Have one worker begin with a command."""
        _send(self.workers[shard], command)

    def process_ids(self) -> list[int]:
        """Worker processes, by id."""
        return [worker.process.pid for worker in self.workers if worker.process.pid is not None]

    def usage(self, busy: Iterable[int] = ()) -> Usage:
        """As the workers last reported; of busy ones, the CPU seconds of this moment."""
        for shard in busy:
            process_id = self.workers[shard].process.pid
            if process_id is not None:
                self.workers[shard].note_cpu_seconds(cpu_seconds_of(process_id))
        return sum((worker.usage for worker in self.workers), Usage(self.lost_cpu_seconds))

    def close(self, hastily: Iterable[int] = ()) -> None:
        """End the workers, busy ones after some seconds of grace, or at once."""
        for shard in hastily:
            self.workers[shard].process.kill()
        for worker in self.workers:
            worker.pipe.close()
        deadline = time.monotonic() + GRACE_S
        for worker in self.workers:
            worker.process.join(max(deadline - time.monotonic(), 0))
            if worker.process.is_alive():
                worker.process.kill()
                worker.process.join()

    def _start(self, shard: int) -> _Worker:
        ours, theirs = self.context.Pipe()
        process = self.context.Process(
            target=run_worker, args=(self.setups[shard], theirs), name=f"headway worker {shard}", daemon=True
        )
        with nullcontext() if self.needs_main else _main_left_out():
            process.start()
        theirs.close()
        return _Worker(process, ours)

    def answer(self, shard: int, command: Command) -> Done:
        """Of a worker that was sent this command, or of the one that replaces it."""
        while (done := self.hear(shard, command)) is None:
            pass
        return done

    def hear(self, shard: int, command: Command) -> Done | None:
        """The same; or None as soon as the worker is found to have failed, and again when the one that
        replaces it has still something to do."""
        worker = self.workers[shard]
        answer = _receive(worker)
        if isinstance(answer, Done):
            worker.remember(worker.repeats.pop(0) if worker.repeats else command, answer)
            if not worker.repeats:
                return answer
            _send(worker, worker.repeats[0])
            return None
        if isinstance(answer, Broken) and answer.is_users:
            raise HeadwayError(answer.line)
        if not worker.repeats:
            self._replace(shard, command, answer)
            return None
        if isinstance(answer, Broken):
            raise WorkerFailedError(f"worker {shard} failed twice: {answer.line}", answer.traceback)
        raise WorkerFailedError(f"worker {shard} failed twice ({answer})", "the worker left no traceback")

    def _replace(self, shard: int, command: Command, first: Broken | str) -> None:
        """Replace a worker that failed, and have its command repeated from where it stood."""
        reason = first.line if isinstance(first, Broken) else first
        old = self.workers[shard]
        old.process.kill()
        old.process.join()
        old.pipe.close()
        self.lost_cpu_seconds += old.usage.cpu_seconds
        worker = self.workers[shard] = self._start(shard)
        # Where the repetition begins: a checkpoint may be written before it is over.
        worker.begun, worker.snapshot = old.begun, old.snapshot
        worker.repeats = [command]
        # Evaluation before the first episodes, or Begin itself, has nothing to go back to.
        if not isinstance(command, Begin | Restore) and old.begun:
            worker.repeats.insert(0, standing(old.snapshot, self.anew))
        anew = any(isinstance(step, Begin) for step in worker.repeats)
        again = "its episodes start again" if anew else "repeating its part from where it stood"
        self.notify(f"worker {shard} failed ({reason}); replaced, {again}")
        _send(worker, worker.repeats[0])


@contextmanager
def _main_left_out() -> Iterator[None]:
    """Start processes without the main module, which each would otherwise run again: it may import torch,
    or train when imported. Multiprocessing finds it by these two attributes."""
    main = sys.modules["__main__"]
    hidden: dict[str, Any] = {
        name: vars(main)[name] for name in ("__spec__", "__file__") if name in vars(main)
    }
    vars(main).update(dict.fromkeys(hidden))
    try:
        yield
    finally:
        vars(main).update(hidden)


class WorkerFailedError(HeadwayError):
    """A worker failed twice in a row; the details are its own traceback."""


def standing(snapshot: Any, anew: str) -> Command:  # noqa: ANN401 - opaque
    """Bring a worker to where a snapshot stands, or to new episodes, of seeds of the purpose `anew`, where
    there is none."""
    return Begin(anew) if snapshot is None else Restore(snapshot)


def _send(worker: _Worker, command: Command) -> None:
    try:
        worker.pipe.send(command)
    except OSError:
        return  # it is dead: `_receive` says so


def _receive(worker: _Worker) -> Done | Broken | str:
    """A worker's answer, or a line that says how it died."""
    try:
        answer: Done | Broken = worker.pipe.recv()
    except (EOFError, OSError):
        worker.process.join(GRACE_S)
        code = worker.process.exitcode
        if code is None:
            return "alive, but it closed its pipe"
        return f"killed by signal {-code}" if code < 0 else f"ended with code {code}"
    return answer
