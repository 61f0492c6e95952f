"""Workers in processes of this machine, which share memory with it."""

import multiprocessing
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext
from multiprocessing import connection
from multiprocessing.context import ForkServerProcess
from typing import Any

from headway.contracts import Trajectory
from headway.contracts.acting_policy import Parameters
from headway.rollout.plan import RolloutPlan, Shard
from headway.rollout.pool_collector import PoolCollector
from headway.rollout.workers.shared_memory import SharedBlock, SharedPickle
from headway.rollout.workers.worker import (
    CommandFailed,
    Command,
    Done,
    Setup,
    WorkerSetup,
    parameter_arrays,
    parameter_bytes,
    run_worker,
)
from headway.rollout.workers.worker_pool import Notify, WorkerConnection

GRACE_S = 5.0
"""How long workers that are told to end may finish what they do, and that hung up may take to die."""


def process_collector(plan: RolloutPlan, shards: Sequence[Shard], notify: Notify) -> PoolCollector:
    """Worker processes, one a shard, that write into one shared trajectory and read one shared set of
    parameters."""
    return PoolCollector(plan, SharedMemoryTransport(plan, shards), len(shards), notify)


class ProcessLauncher:
    """Worker processes, forked from a light server."""

    def __init__(self, setups: Sequence[Setup], preload: Sequence[str], plan: SharedPickle[Any]) -> None:
        """`preload`: modules that they share; `plan`: what the setups hold in common."""
        self.setups, self.plan = setups, plan
        self.context = multiprocessing.get_context("forkserver")
        self.context.set_forkserver_preload(["headway.rollout.workers.worker", *preload])

    def start(self, shard: int) -> "ProcessConnection":
        """See `WorkerLauncher`."""
        ours, theirs = self.context.Pipe()
        process = self.context.Process(
            target=run_worker, args=(self.setups[shard], theirs), name=f"headway worker {shard}", daemon=True
        )
        with nullcontext() if self.plan.mentions_main else _without_main_module():
            process.start()
        theirs.close()
        return ProcessConnection(process, ours)

    def wait(self, waitables: Sequence[Any], timeout_s: float | None) -> list[Any]:
        """See `WorkerLauncher`."""
        return connection.wait(waitables, timeout_s)

    def dismiss(self, links: Sequence[WorkerConnection]) -> None:
        """See `WorkerLauncher`; the seconds of grace are for all together."""
        ours = [link for link in links if isinstance(link, ProcessConnection)]
        for link in ours:
            link.pipe.close()
        deadline = time.monotonic() + GRACE_S
        for link in ours:
            link.process.join(max(deadline - time.monotonic(), 0))
            if link.process.is_alive():
                link.kill()
        self.plan.block.close()


class SharedMemoryTransport(ProcessLauncher):
    """Worker processes that sample into, and by the parameters in, memory that they share with this one."""

    def __init__(self, plan: RolloutPlan, shards: Sequence[Shard]) -> None:
        pickled, shapes = SharedPickle.of(plan), plan.policy.parameter_shapes(plan.replicas)
        self.blocks = (
            SharedBlock.create(plan.layout.nbytes),
            SharedBlock.create(parameter_bytes(shapes), "parameters"),
        )
        self.trajectory = Trajectory.from_buffer(self.blocks[0].buffer, plan.layout)
        self.parameters = parameter_arrays(shapes, self.blocks[1].buffer)
        setups = [WorkerSetup(pickled, shard, *self.blocks) for shard in shards]
        super().__init__(setups, plan.preload, pickled)

    def publish(self, parameters: Parameters) -> None:
        """See `SamplingTransport`."""
        for name, array in self.parameters.items():
            array[...] = parameters[name]

    def close(self) -> None:
        """See `SamplingTransport`."""
        for block in self.blocks:
            block.close()


class ProcessConnection:
    """A worker process and the pipe to it."""

    lost_with_machine = False
    """See `WorkerConnection`: this process would be lost, too."""

    def __init__(self, process: ForkServerProcess, pipe: connection.Connection) -> None:
        self.process, self.pipe = process, pipe

    @property
    def process_id(self) -> int | None:
        """See `WorkerConnection`."""
        return self.process.pid

    @property
    def waitable(self) -> connection.Connection:
        """See `WorkerConnection`."""
        return self.pipe

    def send(self, command: Command) -> None:
        """See `WorkerConnection`."""
        try:
            self.pipe.send(command)
        except OSError:
            return  # it is dead: `receive` says so

    def receive(self) -> Done | CommandFailed | str:
        """See `WorkerConnection`."""
        try:
            answer: Done | CommandFailed = self.pipe.recv()
        except (EOFError, OSError):
            self.process.join(GRACE_S)
            code = self.process.exitcode
            if code is None:
                return "alive, but it closed its pipe"
            return f"killed by signal {-code}" if code < 0 else f"ended with code {code}"
        return answer

    def kill(self) -> None:
        """See `WorkerConnection`."""
        self.process.kill()
        self.process.join()
        self.pipe.close()


@contextmanager
def _without_main_module() -> Iterator[None]:
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
