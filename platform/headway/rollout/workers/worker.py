"""The rollout worker: a light process that executes commands and ends with its parent.

The loop over environment steps is `Sampler.collect`.
"""

import os
import pickle
import signal
import threading
import time
import traceback
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from multiprocessing import connection, parent_process, reduction
from types import MappingProxyType
from typing import Any

from numpy.typing import NDArray

from headway.contracts import Contribution, Contributor, HeadwayError, Trajectory
from headway.contracts.acting_policy import Parameters
from headway.contracts.errors import one_line
from headway.contracts.trajectory import arrays_in
from headway.events import Row, Usage
from headway.rollout.episodes import EvaluationRequest, evaluate_policy
from headway.rollout.forks import end_if_forked
from headway.rollout.plan import RolloutPlan, Shard
from headway.rollout.sampler import Episode, Sampler
from headway.rollout.workers.shared_memory import SharedBlock, SharedPickle, give_back_memory
from headway.rollout.workers.usage import OwnUsage


@dataclass(frozen=True)
class WorkerSetup:
    """The data that a worker starts with."""

    plan: SharedPickle[RolloutPlan] | bytes
    """A pickled `RolloutPlan`, in shared memory if the worker is on this machine."""
    shard: Shard
    memory: tuple[SharedBlock, SharedBlock] | None = None
    """Trajectory and parameters of all workers; None: the worker has a trajectory of its shard."""
    parameters: dict[str, NDArray[Any]] = field(default_factory=dict)
    """Parameters of all replicas, if they are not in `memory`; they change between commands."""

    def open(self) -> "WorkerService":
        """Return the worker's service.

        Called in the worker at its first command, so that a loading error becomes an answer.
        """
        plan: RolloutPlan = pickle.loads(self.plan) if isinstance(self.plan, bytes) else self.plan.load()
        if self.memory is None:
            return WorkerService(plan, self.shard, self.parameters)
        experience, acting = (block.buffer for block in self.memory)
        parameters = arrays_in(acting, plan.policy.parameter_shapes(plan.replicas))
        return WorkerService(plan, self.shard, parameters, Trajectory.from_buffer(experience, plan.layout))


@dataclass(frozen=True)
class Begin:
    """Start new episodes."""

    purpose: str
    """Purpose of the random stream of their seeds."""


@dataclass(frozen=True)
class Restore:
    """Continue from a snapshot."""

    snapshot: Any


@dataclass(frozen=True)
class Collect:
    """Sample one iteration."""

    iteration: int


@dataclass(frozen=True)
class Evaluate:
    """Play evaluation episodes of some of the replicas."""

    request: EvaluationRequest
    first_replica: int
    replicas: int


@dataclass(frozen=True)
class Contribute:
    """Sample with the published parameters and compute a contribution from the trajectory."""

    number: int
    """Number of the contribution, from 1 in order of assignment; an index of its random streams."""
    updates: int
    """Updates that the learner had made when the task was assigned."""
    published: Parameters
    """Result of `AsynchronousLearner.published`."""


Command = Begin | Restore | Collect | Evaluate | Contribute


@dataclass(frozen=True)
class Done:
    """The answer to an executed command."""

    episodes: list[Episode]
    """Training episodes that ended."""
    evaluation: list[list[Row]]
    """One list per evaluated replica, with one row per episode."""
    snapshot: Any
    """State after the command; None for evaluation and for environments without snapshots."""
    usage: Usage
    """Usage of the worker since it started."""
    contribution: Contribution | None = None
    seconds: float = 0.0
    """Wall time of the command in the worker."""


@dataclass(frozen=True)
class CommandFailed:
    """The answer to a command that raised an exception."""

    line: str
    traceback: str
    is_user_error: bool
    """The exception was a HeadwayError: the user must act, and repeating the command is useless."""


def run_worker(setup: WorkerSetup, commands: connection.Connection) -> None:
    """Execute commands until the pipe closes."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the session handles Ctrl-C
    threading.Thread(target=_exit_with_parent, daemon=True).start()
    server = CommandServer(setup)
    while True:
        try:
            command: Command = commands.recv()
        except (EOFError, OSError):
            return
        answer = server.answer(command)
        try:
            commands.send_bytes(answer)
        except OSError:
            return  # the parent has closed the pipe


class CommandServer:
    """Opens a worker's service at the first command and turns its exceptions into answers."""

    def __init__(self, setup: WorkerSetup) -> None:
        self.setup = setup
        self.service: WorkerService | None = None
        self._process_id = os.getpid()

    def answer(self, command: Command) -> memoryview:
        """Execute a command; return a pickled `Done` or `CommandFailed`.

        Does not return in a process that the environment forked off.
        """
        try:
            self.service = self.service or self.setup.open()
            began = time.monotonic()
            done = self.service.execute(command)
            end_if_forked(self._process_id)
            # Pickled inside the try block: a snapshot that cannot be pickled becomes an answer too.
            return reduction.ForkingPickler.dumps(replace(done, seconds=time.monotonic() - began))
        except BaseException as error:  # an environment may also call sys.exit
            end_if_forked(self._process_id)
            is_user_error = isinstance(error, HeadwayError)
            failed = CommandFailed(one_line(error), traceback.format_exc(), is_user_error)
            return reduction.ForkingPickler.dumps(failed)


class WorkerService:
    """Executes a worker's commands: samples one shard, evaluates, contributes in asynchronous training."""

    def __init__(
        self,
        plan: RolloutPlan,
        shard: Shard,
        parameters: Mapping[str, NDArray[Any]] = MappingProxyType({}),
        trajectory: Trajectory | None = None,
    ) -> None:
        """`parameters` are those of all replicas and may change between commands. `trajectory` is that of all
        workers; None: the worker has one of its shard."""
        self.plan, self.shard, self.parameters = plan, shard, parameters
        if trajectory is None:
            of_shard = plan.of_replicas(shard.first_replica, shard.replicas)
            trajectory = Trajectory.allocate(replace(of_shard, copies=shard.count).layout)
        self.trajectory = trajectory
        self.own_usage = OwnUsage()

    @cached_property
    def sampler(self) -> Sampler:
        """Sampler of the shard, created on first use: workers that only evaluate need none."""
        return Sampler(self.plan, self.shard, self.trajectory)

    @cached_property
    def contributor(self) -> Contributor | None:
        """Computes contributions; None in synchronous training."""
        return None if self.plan.make_contributor is None else self.plan.make_contributor()

    def snapshot(self) -> Any:  # noqa: ANN401 - opaque, plain
        """Return the state between two commands; None if the environment has no snapshots."""
        state = self.sampler.snapshot()
        if state is None or self.contributor is None:
            return state
        return {"sampler": state, "learned": self.contributor.snapshot()}

    def execute(self, command: Command) -> Done:
        """Execute a command."""
        episodes: list[Episode] = []
        contribution: Contribution | None = None
        match command:
            case Evaluate(request=request, first_replica=first, replicas=number):
                plan, parameters = self.plan, self.plan.parameters_of(self.parameters, first, number)
                evaluation = evaluate_policy(plan.of_replicas(first, number), parameters, request)
                give_back_memory()
                return Done([], evaluation, None, self.own_usage.read())
            case Begin(purpose=purpose):
                self.sampler.begin(purpose)
            case Restore(snapshot=snapshot) if self.contributor is not None:
                self.sampler.restore(snapshot["sampler"])
                self.contributor.restore(snapshot["learned"])
            case Restore(snapshot=snapshot):
                self.sampler.restore(snapshot)
            case Collect(iteration=iteration):
                episodes = self.sampler.collect(iteration, self.parameters)
            case Contribute(number=number, published=published):
                assert self.contributor is not None
                episodes = self.sampler.collect(number, self.contributor.adopt(published))
                contribution = self.contributor.contribute(self.trajectory, number)
        return Done(episodes, [], self.snapshot(), self.own_usage.read(), contribution)


def _exit_with_parent() -> None:
    parent = parent_process()
    if parent is not None:
        connection.wait([parent.sentinel])
        os._exit(1)
