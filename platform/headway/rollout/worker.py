"""The rollout worker: a light process that samples when told to, and ends when its parent does."""

import os
import signal
import threading
import traceback
from collections.abc import Mapping
from dataclasses import dataclass
from math import prod
from multiprocessing import connection, parent_process, reduction
from typing import Any

import numpy as np
from numpy.typing import NDArray

from headway.contracts import HeadwayError, Trajectory, TrajectoryLayout
from headway.events import Row
from headway.rollout.episodes import EvaluationRequest, evaluate_policy
from headway.rollout.memory import SharedBlock
from headway.rollout.plan import RolloutPlan
from headway.rollout.sampler import Episode, Sampler
from headway.rollout.usage import cpu_seconds, proportional_memory


@dataclass(frozen=True)
class WorkerSetup:
    """All that a worker is given when it starts."""

    plan: RolloutPlan
    first: int
    count: int
    trajectory: SharedBlock
    parameters: SharedBlock


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
    """Play evaluation episodes."""

    request: EvaluationRequest


Command = Begin | Restore | Collect | Evaluate


@dataclass(frozen=True)
class Done:
    """A command carried out."""

    episodes: list[Episode]
    evaluation: list[list[Row]]
    snapshot: Any
    cpu_seconds: float
    memory_bytes: int


@dataclass(frozen=True)
class Broken:
    """A command that raised."""

    line: str
    traceback: str
    is_users: bool
    """The user can mend it: trying again is of no use."""


def parameter_arrays(
    shapes: Mapping[str, tuple[tuple[int, ...], np.dtype[Any]]],
    buffer: Any,  # noqa: ANN401 - a buffer
) -> dict[str, NDArray[Any]]:
    """Arrays by name, one after another in a buffer."""
    arrays, offset = {}, 0
    for name, (shape, dtype) in shapes.items():
        arrays[name] = np.frombuffer(buffer, dtype, prod(shape), offset).reshape(shape)
        offset += -(-arrays[name].nbytes // 64) * 64
    return arrays


def parameter_bytes(shapes: Mapping[str, tuple[tuple[int, ...], np.dtype[Any]]]) -> int:
    """Size of the buffer that `parameter_arrays` needs."""
    return sum(-(-prod(shape) * dtype.itemsize // 64) * 64 for shape, dtype in shapes.values())


def run_worker(setup: WorkerSetup, commands: connection.Connection) -> None:
    """Serve commands until the pipe closes."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the session's to answer
    threading.Thread(target=_end_with_parent, daemon=True).start()
    plan = setup.plan
    layout = TrajectoryLayout(plan.spec, plan.steps, plan.replicas * plan.copies)
    trajectory = Trajectory.over(setup.trajectory.buffer, layout)
    parameters = parameter_arrays(plan.policy.parameter_shapes(plan.replicas), setup.parameters.buffer)
    sampler: Sampler | None = None
    while True:
        try:
            command: Command = commands.recv()
        except (EOFError, OSError):
            return
        try:
            if sampler is None and not isinstance(command, Evaluate):
                sampler = Sampler(plan, setup.first, setup.count, trajectory)
            # Pickled here, so that a snapshot that cannot be is an error like any other.
            answer = reduction.ForkingPickler.dumps(_carry_out(command, plan, sampler, parameters))
        except Exception as error:
            line = str(error) if isinstance(error, HeadwayError) else f"{type(error).__name__}: {error}"
            is_users = isinstance(error, HeadwayError)
            answer = reduction.ForkingPickler.dumps(Broken(line, traceback.format_exc(), is_users))
        try:
            commands.send_bytes(answer)
        except OSError:
            return  # nobody listens any more


def _carry_out(
    command: Command, plan: RolloutPlan, sampler: Sampler | None, parameters: dict[str, NDArray[Any]]
) -> Done:
    if isinstance(command, Evaluate):
        evaluation = evaluate_policy(plan, parameters, command.request)
        return Done([], evaluation, None, cpu_seconds(), proportional_memory())
    assert sampler is not None
    episodes: list[Episode] = []
    match command:
        case Begin(purpose=purpose):
            sampler.begin(purpose)
        case Restore(snapshot=snapshot):
            sampler.restore(snapshot)
        case Collect(iteration=iteration):
            episodes = sampler.collect(iteration, parameters)
    return Done(episodes, [], sampler.snapshot(), cpu_seconds(), proportional_memory())


def _end_with_parent() -> None:
    parent = parent_process()
    if parent is not None:
        connection.wait([parent.sentinel])
        os._exit(1)
