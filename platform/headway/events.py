"""Events that a training process sends to its session over a pipe. Every record is picklable.

A training process trains one stack of seeds. Events report its progress; tables are written to the run
folders and not sent.
"""

from collections.abc import Mapping
from dataclasses import dataclass

Row = Mapping[str, float | int | str]
"""One row of a table: values by column."""

LABELS = frozenset({"copy", "episode_seed", "evaluation_seed", "iteration", "env_steps", "mode", "final"})
"""Columns that identify an episode in tables of episodes. All other columns are metrics."""


@dataclass(frozen=True, slots=True)
class Usage:
    """CPU time and memory of a group of processes."""

    cpu_seconds: float = 0.0
    """CPU seconds since the processes started, dead processes included."""
    memory_bytes: int = 0
    """Proportional set size in bytes, over the processes alive."""

    def __add__(self, other: "Usage") -> "Usage":
        return Usage(self.cpu_seconds + other.cpu_seconds, self.memory_bytes + other.memory_bytes)


@dataclass(frozen=True, slots=True)
class Started:
    """Training has started, or resumed after iteration `iteration`."""

    iteration: int
    """Iterations finished so far; 0 for a new run."""
    process_ids: tuple[int, ...]
    """The training process and its workers."""
    episodes_restarted: bool = False
    """The run resumed with new episodes, because the environment has no snapshots."""


@dataclass(frozen=True, slots=True)
class IterationFinished:
    """One iteration of sampling and learning is finished."""

    iteration: int
    """Number of the iteration, from 1."""
    env_steps: int
    """Environment steps per seed so far."""
    usage: Usage
    """Usage of the training process and its workers."""
    wall_s: float
    """Seconds of training so far, earlier sessions included, on the training process's clock."""
    collect_s: float
    """Seconds of the iteration spent sampling."""
    learn_s: float
    """Seconds of the iteration spent learning."""


@dataclass(frozen=True, slots=True)
class EvaluationFinished:
    """The evaluation episodes of every seed at one point of training are finished."""

    iteration: int
    """Iterations finished before the evaluation."""
    env_steps: int
    """Environment steps per seed so far."""
    mode: str
    """`greedy` or `sampled`."""
    usage: Usage
    """Usage of the training process and its workers."""
    mean_return: float
    """Mean return over the seeds, as in the learning curve."""


@dataclass(frozen=True, slots=True)
class CheckpointSaved:
    """Everything up to `iteration` is durable in the run folders."""

    iteration: int
    """Last iteration in the checkpoint."""


@dataclass(frozen=True, slots=True)
class Notice:
    """One line for the user, for example about a replaced worker or a skipped checkpoint."""

    line: str


@dataclass(frozen=True, slots=True)
class Finished:
    """Last event of a job that ended normally."""

    iteration: int
    """Last finished iteration."""
    stopped: bool
    """The job was stopped on request before its budget was used."""
    usage: Usage | None = None
    """Usage of the training process and its workers; None if the process was killed before it could
    report."""
    store_s: float = 0.0
    """Seconds spent writing logs and checkpoints."""


@dataclass(frozen=True, slots=True)
class Failed:
    """Last event of a job that could not continue."""

    line: str
    """One line: what is wrong and what to do."""
    traceback: str
    lost: bool = False
    """Whether workers or their cluster were lost; False: training itself failed."""


Event = Started | IterationFinished | EvaluationFinished | CheckpointSaved | Notice | Finished | Failed
