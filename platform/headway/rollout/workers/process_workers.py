"""Worker processes on this machine, and the memory that the training process shares with them."""

import multiprocessing
import time
from collections.abc import Sequence
from contextlib import nullcontext
from multiprocessing import connection
from multiprocessing.context import ForkServerProcess
from typing import Any

from headway.contracts import HeadwayError, Trajectory
from headway.contracts.acting_policy import Parameters
from headway.contracts.trajectory import arrays_in, block_nbytes
from headway.rollout.forks import without_main_module
from headway.rollout.plan import RolloutPlan, Shard
from headway.rollout.workers.shared_memory import SharedBlock, SharedPickle
from headway.rollout.workers.worker import Command, CommandFailed, Done, WorkerSetup, run_worker
from headway.rollout.workers.worker_pool import WorkerConnection

GRACE_S = 5.0
"""Seconds that workers may take to finish their command on closing, or to die after closing their pipe."""

_START_ATTEMPTS, _START_PAUSE_S = 10, 0.1


class ProcessLauncher:
    """Starts worker processes with multiprocessing's forkserver."""

    def __init__(
        self,
        plan: RolloutPlan,
        shards: Sequence[Shard],
        memory: tuple[SharedBlock, SharedBlock] | None = None,
    ) -> None:
        """`memory`: see `WorkerSetup`."""
        self.plan = SharedPickle.of(plan)
        self.blocks = self.plan.block, *(memory or ())
        self.setups = [WorkerSetup(self.plan, shard, memory) for shard in shards]
        self.context = multiprocessing.get_context("forkserver")
        policy = type(plan.policy).__module__
        preload = [*plan.preload, *([policy] if policy != "__main__" else [])]
        self.context.set_forkserver_preload(["headway.rollout.workers.worker", *preload])

    def start(self, shard: int) -> "ProcessConnection":
        """Start the worker process of a shard."""
        ours, theirs = self.context.Pipe()
        process = self.context.Process(
            target=run_worker, args=(self.setups[shard], theirs), name=f"headway worker {shard}", daemon=True
        )
        with nullcontext() if self.plan.mentions_main else without_main_module():
            _start(process)
        theirs.close()
        return ProcessConnection(process, ours)

    def wait(self, waitables: Sequence[Any], timeout_s: float | None) -> list[Any]:
        """Return the pipes that are ready, see `WorkerLauncher.wait`."""
        return connection.wait(waitables, timeout_s)

    def dismiss(self, links: Sequence[WorkerConnection]) -> None:
        """End the workers, with one grace period for all of them, and close the shared blocks."""
        ours = [link for link in links if isinstance(link, ProcessConnection)]
        for link in ours:
            link.pipe.close()
        deadline = time.monotonic() + GRACE_S
        for link in ours:
            link.process.join(max(deadline - time.monotonic(), 0))
            if link.process.is_alive():
                link.kill()
        for block in self.blocks:
            block.close()


class SamplingProcessLauncher(ProcessLauncher):
    """Starts worker processes of synchronous training; trajectory and parameters lie in shared memory."""

    def __init__(self, plan: RolloutPlan, shards: Sequence[Shard]) -> None:
        shapes = plan.policy.parameter_shapes(plan.replicas)
        experience = SharedBlock.create(plan.layout.nbytes)
        acting = SharedBlock.create(block_nbytes(shapes), "parameters")
        super().__init__(plan, shards, (experience, acting))
        self.trajectory = Trajectory.from_buffer(experience.buffer, plan.layout)
        self.parameters = arrays_in(acting.buffer, shapes)

    def publish(self, parameters: Parameters) -> None:
        """Copy the parameters to shared memory."""
        for name, array in self.parameters.items():
            array[...] = parameters[name]


class ProcessConnection:
    """A worker process and the pipe to it."""

    lost_with_machine = False
    """False: the worker runs on this machine."""

    def __init__(self, process: ForkServerProcess, pipe: connection.Connection) -> None:
        self.process, self.pipe = process, pipe

    @property
    def process_id(self) -> int | None:
        """Id of the worker process."""
        return self.process.pid

    @property
    def waitable(self) -> connection.Connection:
        """The pipe."""
        return self.pipe

    def await_start(self) -> None:
        """Return at once: the worker does not wait for free CPUs."""

    def send(self, command: Command) -> None:
        """Send a command, if the worker is alive."""
        try:
            self.pipe.send(command)
        except OSError:
            return  # the worker is dead, which `receive` reports

    def receive(self) -> Done | CommandFailed | str:
        """Return the answer, or how the process ended."""
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
        """Kill the process."""
        self.process.kill()
        self.process.join()
        self.pipe.close()


def _start(process: ForkServerProcess) -> None:
    """Start a process, with a new fork server if the present one is ending. Raises HeadwayError if that
    fails."""
    for _ in range(_START_ATTEMPTS):
        try:
            process.start()
            return
        except (EOFError, ConnectionError) as error:
            cause = error
            time.sleep(_START_PAUSE_S)
    raise HeadwayError(
        "the fork server, which starts worker processes, keeps ending (out of memory?); lower "
        "backend.workers or backend.parallel"
    ) from cause
