"""Progress of a session's jobs, individually and in total."""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from heapq import heapreplace
from typing import Literal

from headway.events import EvaluationFinished, Event, Failed, Finished, IterationFinished, Started

Status = Literal["waiting", "starting", "training", "finished", "paused", "stopped", "failed", "elsewhere"]
ACTIVE: tuple[Status, ...] = ("starting", "training")
ENDED: tuple[Status, ...] = ("finished", "failed")
"""Statuses of ended jobs; a paused or stopped job has not ended, since it can be continued."""
OVER: tuple[Status, ...] = (*ENDED, "paused", "stopped", "elsewhere")
"""Statuses of jobs that are over for this session.

`paused`: trained as far as planned, such as to a rung of a search; `elsewhere`: another session trains or
finished it.
"""


@dataclass
class JobProgress:
    """Progress of one job, updated by `take` with the events of its process."""

    seeds: tuple[int, ...]
    iterations: int
    """Last iteration, or that after which it is to pause."""
    mode: str
    """Evaluation mode of the return shown first."""
    iteration_steps: int
    """Environment steps per seed and iteration."""
    status: Status = "waiting"
    iteration: int = 0
    returns: dict[str, float] = field(default_factory=dict)
    """Mean return of the last evaluation in each mode."""
    label: str = ""
    """Name of its cell if the session has several."""
    traceback: str = ""
    """File that gets the traceback if it fails; empty before its runs are stored."""
    _marks: deque[tuple[float, int, int]] = field(default_factory=lambda: deque(maxlen=20))
    """(clock of the training process in s, iteration, environment steps) of recent iterations."""

    def take(self, event: Event) -> None:
        """Update with an event."""
        match event:
            case Started(iteration=iteration):
                self.status, self.iteration = "training", iteration
            case IterationFinished(iteration=iteration, env_steps=env_steps, wall_s=wall_s):
                # Measured from the end of the first iteration, which includes start-up and compilation.
                self.iteration = iteration
                self._marks.append((wall_s, iteration, env_steps))
            case EvaluationFinished(mode=mode, mean_return=mean_return):
                self.returns[mode] = mean_return
            case Finished(stopped=stopped):
                paused = self.iteration >= self.iterations
                self.status = ("paused" if paused else "stopped") if stopped else "finished"
            case Failed():
                self.status = "failed"

    @property
    def name(self) -> str:
        """Name of the job, such as `seed 3` or `ippo, seeds 0..4`."""
        last = f"..{self.seeds[-1]}" if len(self.seeds) > 1 else ""
        seeds = f"seed{'s' if last else ''} {self.seeds[0]}{last}"
        return f"{self.label}, {seeds}" if self.label else seeds

    @property
    def evaluation_return(self) -> float | None:
        """Mean return of the last evaluation in `mode`; None before the first."""
        return self.returns.get(self.mode)

    @property
    def env_steps(self) -> int:
        """Environment steps per seed so far, including those before a resume."""
        return self.iteration * self.iteration_steps

    @property
    def steps_per_second(self) -> float | None:
        """Environment steps per second over recent iterations, all seeds of the job together."""
        if len(self._marks) < 2:
            return None
        (begin, _, first), (end, _, last) = self._marks[0], self._marks[-1]
        return (last - first) * len(self.seeds) / max(end - begin, 1e-9)

    @property
    def seconds_per_step(self) -> float | None:
        """Seconds per environment step over recent iterations, evaluations included."""
        return None if (speed := self.steps_per_second) is None else 1 / max(speed, 1e-9)

    @property
    def steps_left(self) -> int:
        """Environment steps left, all seeds of the job together."""
        return (self.iterations - self.iteration) * self.iteration_steps * len(self.seeds)

    @property
    def seconds_left(self) -> float | None:
        """Expected time to the last iteration, s; None before the speed is known."""
        each = self.seconds_per_step
        return None if each is None else each * self.steps_left

    def cells(self) -> tuple[str, ...]:
        """Return name, iteration, steps, speed, last evaluation, and time left or status."""
        speed, left = self.steps_per_second, self.seconds_left
        training = self.status == "training"
        return (
            self.name,
            f"{self.iteration}/{self.iterations}",
            f"{self.env_steps:,} steps",
            f"{speed:,.0f} steps/s" if speed is not None and training else "",
            self._returns(),
            f"{duration(left)} left" if left is not None and training else self.status,
        )

    def _returns(self) -> str:
        """Return `return 133.1 (sampled 5.944)`; empty before the first evaluation.

        A greedy policy may stay the same for a long time while the probabilities of its actions change.
        """
        if self.evaluation_return is None:
            return ""
        others = [f"{mode} {value:.4g}" for mode, value in self.returns.items() if mode != self.mode]
        return f"return {self.evaluation_return:.4g}" + (f" ({', '.join(others)})" if others else "")


def duration(seconds: float) -> str:
    """Format a duration as `0:04:09`."""
    minutes, whole = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{whole:02d}"


def seeds_with(jobs: Sequence[JobProgress], *statuses: Status) -> int:
    """Return the number of seeds with one of these statuses."""
    return sum(len(job.seeds) for job in jobs if job.status in statuses)


def counts(jobs: Sequence[JobProgress], *statuses: Status) -> list[str]:
    """Return the number of seeds with each status, such as `2 failed`, if there are any."""
    return [f"{number} {status}" for status in statuses if (number := seeds_with(jobs, status))]


def overall(jobs: Sequence[JobProgress], parallel: int) -> str:
    """Format the total: `12 of 30 runs ended (1 failed), 2 training, 3,210 steps/s, about 0:04:09 left`."""
    failed = seeds_with(jobs, "failed")
    active = [job for job in jobs if job.status in ACTIVE]
    parts = [f"{seeds_with(jobs, *ENDED)} of {sum(len(job.seeds) for job in jobs)} runs ended"]
    parts[0] += f" ({failed} failed)" if failed else ""
    parts += counts(jobs, "paused", "stopped")
    elsewhere = seeds_with(jobs, "elsewhere")
    parts += [f"{elsewhere} left to other sessions"] if elsewhere else []
    parts.append(f"{seeds_with(jobs, *ACTIVE)} training")
    speeds = [speed for job in active if (speed := job.steps_per_second) is not None]
    if speeds:
        parts.append(f"{sum(speeds):,.0f} steps/s")
    left = seconds_left(jobs, parallel)
    if left is not None:
        parts.append(f"about {duration(left)} left")
    return ", ".join(parts)


def seconds_left(jobs: Sequence[JobProgress], parallel: int) -> float | None:
    """Return the expected time to the end of all jobs, `parallel` at a time, s; None without any speed.

    Jobs without a speed are assumed to be as fast as the others of their cell, or as all jobs.
    """
    paces: dict[str, list[float]] = {}
    for job in jobs:
        if (pace := job.seconds_per_step) is not None:
            paces.setdefault(job.label, []).append(pace)
    known = [pace for of_cell in paces.values() for pace in of_cell]
    left = [job for job in jobs if job.status not in OVER]
    remaining = sorted(left, key=lambda job: job.status == "waiting")  # these start as others end
    if not known or not remaining:
        return None
    lengths = []
    for job in remaining:
        of_cell = paces.get(job.label, known)
        lengths.append((job.seconds_per_step or sum(of_cell) / len(of_cell)) * job.steps_left)
    return makespan(lengths, parallel)


def makespan(seconds: Sequence[float], parallel: int) -> float:
    """Return the seconds until all jobs have ended if they start in order, `parallel` at a time."""
    free = [0.0] * max(parallel, 1)
    for each in seconds:
        heapreplace(free, free[0] + each)
    return max(free)
