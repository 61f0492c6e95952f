"""The rollout worker: a light process that samples when told to, and ends when its parent does."""

import os
import signal
import threading
import traceback
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from math import prod
from multiprocessing import connection, parent_process, reduction
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from headway.contracts import Contribution, HeadwayError, Trajectory
from headway.contracts.acting_policy import Parameters
from headway.contracts.trajectory import aligned
from headway.events import Row, Usage
from headway.rollout.episodes import EvaluationRequest, evaluate_policy
from headway.rollout.plan import RolloutPlan, Shard
from headway.rollout.sampler import Episode, Sampler
from headway.rollout.workers.shared_memory import SharedBlock, SharedPickle, give_back_memory
from headway.rollout.workers.usage import OwnUsage


@dataclass(frozen=True)
class WorkerSetup:
    """All that a worker is given that samples into a shared trajectory."""

    plan: SharedPickle[RolloutPlan]
    shard: Shard
    trajectory: SharedBlock
    parameters: SharedBlock

    def open(self) -> "Sampling":
        """The service of a worker that samples."""
        plan = self.plan.load()
        shapes = plan.policy.parameter_shapes(plan.replicas)
        return SamplingService(
            plan,
            self.shard,
            Trajectory.from_buffer(self.trajectory.buffer, plan.layout),
            parameter_arrays(shapes, self.parameters.buffer),
        )


@dataclass(frozen=True)
class Begin:
    """Start the first episodes; `purpose` names the stream of their seeds."""

    purpose: str


@dataclass(frozen=True)
class Restore:
    """Go on from a snapshot."""

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
    """Sample with these parameters, and say what the learner is to make of it."""

    number: int
    """Of the contribution, from 1, in the order in which they were given out. Names the draws."""
    updates: int
    """Made when the parameters were given out."""
    published: Parameters
    """All that learning changes, as `AsynchronousLearner.published` tells it."""


Command = Begin | Restore | Collect | Evaluate | Contribute


@dataclass(frozen=True)
class Done:
    """A command carried out."""

    episodes: list[Episode]
    evaluation: list[list[Row]]
    """One list a replica that was to be evaluated, one row an episode."""
    snapshot: Any
    usage: Usage
    contribution: Contribution | None = None


class Service(Protocol):
    """What a worker does."""

    def execute(self, command: Command) -> Done:
        """Do as told."""
        ...


class Setup(Protocol):
    """All that a worker is given when it starts."""

    def open(self) -> Service:
        """At the first command, in the worker, so that what cannot be loaded is told."""
        ...


@dataclass(frozen=True)
class CommandFailed:
    """A command that raised."""

    line: str
    traceback: str
    is_user_error: bool
    """The user can mend it: trying again is of no use."""


def parameter_arrays(
    shapes: Mapping[str, tuple[tuple[int, ...], np.dtype[Any]]],
    buffer: Any,  # noqa: ANN401 - a buffer
) -> dict[str, NDArray[Any]]:
    """Arrays by name, one after another in a buffer."""
    arrays, offset = {}, 0
    for name, (shape, dtype) in shapes.items():
        arrays[name] = np.frombuffer(buffer, dtype, prod(shape), offset).reshape(shape)
        offset += aligned(arrays[name].nbytes)
    return arrays


def parameter_bytes(shapes: Mapping[str, tuple[tuple[int, ...], np.dtype[Any]]]) -> int:
    """Size of the buffer that `parameter_arrays` needs."""
    return sum(aligned(prod(shape) * dtype.itemsize) for shape, dtype in shapes.values())


def run_worker(setup: Setup, commands: connection.Connection) -> None:
    """Serve commands until the pipe closes."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the session's to answer
    threading.Thread(target=_end_with_parent, daemon=True).start()
    serving = CommandServer(setup)
    while True:
        try:
            command: Command = commands.recv()
        except (EOFError, OSError):
            return
        answer = serving.answer(command)
        try:
            commands.send_bytes(answer)
        except OSError:
            return  # nobody listens any more


class CommandServer:
    """A worker's service, opened at the first command, with what it raises made an answer."""

    def __init__(self, setup: Setup) -> None:
        self.setup = setup
        self.service: Service | None = None

    def answer(self, command: Command) -> memoryview:
        """A `Done` or a `Broken`, pickled."""
        try:
            self.service = self.service or self.setup.open()
            # Pickled here, so that a snapshot that cannot be is an error like any other.
            return reduction.ForkingPickler.dumps(self.service.execute(command))
        except Exception as error:
            line = str(error) if isinstance(error, HeadwayError) else f"{type(error).__name__}: {error}"
            is_user_error = isinstance(error, HeadwayError)
            return reduction.ForkingPickler.dumps(CommandFailed(line, traceback.format_exc(), is_user_error))


class SamplingService:
    """The plan at work on one shard."""

    def __init__(
        self,
        plan: RolloutPlan,
        shard: Shard,
        trajectory: Trajectory,
        parameters: Parameters,
        own: bool = False,
    ) -> None:
        """`parameters`: of all replicas, may change between two commands; `own`: as `Sampler`'s."""
        self.plan, self.shard, self.own = plan, shard, own
        self.trajectory, self.parameters = trajectory, parameters
        self.own_usage = OwnUsage()

    @cached_property
    def sampler(self) -> Sampler:
        """Not made by a worker that only evaluates."""
        return Sampler(self.plan, self.shard, self.trajectory, self.own)

    def execute(self, command: Command) -> Done:
        """Do as told."""
        episodes: list[Episode] = []
        match command:
            case Evaluate(request=request, first_replica=first, replicas=number):
                plan, parameters = self.plan, self.plan.parameters_of(self.parameters, first, number)
                evaluation = evaluate_policy(plan.of_replicas(first, number), parameters, request)
                give_back_memory()
                return Done([], evaluation, None, self.own_usage.read())
            case Begin(purpose=purpose):
                self.sampler.begin(purpose)
            case Restore(snapshot=snapshot):
                self.sampler.restore(snapshot)
            case Collect(iteration=iteration):
                episodes = self.sampler.collect(iteration, self.parameters)
        return Done(episodes, [], self.sampler.snapshot(), self.own_usage.read())


def _end_with_parent() -> None:
    parent = parent_process()
    if parent is not None:
        connection.wait([parent.sentinel])
        os._exit(1)
