"""What a training process tells its session, over a pipe; every record is picklable.

A training process trains one stack of seeds: `seeds` of its job, in order; tuples "one a seed" follow it.
"""

from collections.abc import Mapping
from dataclasses import dataclass

Row = Mapping[str, float | int | str]

LABELS = frozenset({"copy", "episode_seed", "evaluation_seed", "iteration", "env_steps", "mode", "final"})
"""Columns of tables of episodes that say which one it was; the others are its figures."""


@dataclass(frozen=True, slots=True)
class Usage:
    """What processes have used."""

    cpu_seconds: float = 0.0
    """Since they started, dead ones included."""
    memory_bytes: int = 0
    """Proportional memory, of those alive."""

    def __add__(self, other: "Usage") -> "Usage":
        return Usage(self.cpu_seconds + other.cpu_seconds, self.memory_bytes + other.memory_bytes)


@dataclass(frozen=True, slots=True)
class Started:
    """Training has begun (or goes on, from `iteration`)."""

    iteration: int
    process_ids: tuple[int, ...]
    """The training process and its workers."""
    episodes_restarted: bool = False
    """It goes on with episodes begun anew: the environment keeps no snapshots."""


@dataclass(frozen=True, slots=True)
class IterationFinished:
    """One iteration of collecting and learning."""

    iteration: int
    """Counted from 1."""
    env_steps: int
    """Environment steps of each seed so far."""
    usage: Usage
    """Of the training process and its workers."""
    curve: tuple[Row, ...]
    """One a seed: `iteration`, `env_steps`, `wall_s` and metrics by `group/name`."""


@dataclass(frozen=True, slots=True)
class EvaluationFinished:
    """Evaluation episodes of every seed at one point of training."""

    iteration: int
    env_steps: int
    mode: str
    final: bool
    usage: Usage
    """Of the training process and its workers."""
    curve: tuple[Row, ...]
    """One a seed: `iteration`, `env_steps`, `wall_s` and means by `evaluation_MODE/name`."""


@dataclass(frozen=True, slots=True)
class CheckpointSaved:
    """Everything up to `iteration` is durable in the run folders."""

    iteration: int


@dataclass(frozen=True, slots=True)
class Notice:
    """One line for the user: a worker replaced, a checkpoint skipped."""

    line: str


@dataclass(frozen=True, slots=True)
class Finished:
    """The last event of a job that ended as meant; `stopped` when it was asked to stop before its budget."""

    iteration: int
    stopped: bool
    usage: Usage | None = None
    """Of the training process and its workers; None where it was killed and could not tell."""
    store_s: float = 0.0
    """Seconds that it spent on its log and checkpoints."""


@dataclass(frozen=True, slots=True)
class Failed:
    """The last event of a job that could not go on."""

    line: str
    traceback: str


Event = Started | IterationFinished | EvaluationFinished | CheckpointSaved | Notice | Finished | Failed
