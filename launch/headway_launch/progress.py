"""What a session shows while it trains: one line a training process, on stderr."""

import sys
import time
from collections import deque
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from types import TracebackType
from typing import TYPE_CHECKING, Literal, Self

from headway.events import EvaluationFinished, Event, IterationFinished, Started
from headway_launch.telling import silence, tell

if TYPE_CHECKING:
    from rich.live import Live
    from rich.table import Table

Status = Literal["waiting", "starting", "training", "finished", "stopped", "failed"]
_PLAIN_EVERY_S = 30.0


@dataclass
class JobProgress:
    """How far one job is; `take` brings it up to date with what its process reports."""

    seeds: tuple[int, ...]
    iterations: int
    mode: str
    """The evaluation mode whose return is shown."""
    status: Status = "waiting"
    iteration: int = 0
    env_steps: int = 0
    evaluation_return: float | None = None
    _marks: deque[tuple[float, int, int]] = field(default_factory=lambda: deque(maxlen=20))
    """(training process's clock in s, iteration, environment steps) of the last iterations."""

    def take(self, event: Event) -> None:
        """Bring up to date with an event."""
        match event:
            case Started(iteration=iteration):
                self.status, self.iteration = "training", iteration
            case IterationFinished(iteration=iteration, env_steps=env_steps, curve=curve):
                # Speed counts from the end of the first iteration, which holds the start and compilation.
                self.iteration, self.env_steps = iteration, env_steps
                self._marks.append((float(curve[0]["wall_s"]), iteration, env_steps))
            case EvaluationFinished(mode=mode, curve=curve) if mode == self.mode:
                returns = [float(row[f"evaluation_{mode}/return"]) for row in curve]
                self.evaluation_return = sum(returns) / len(returns)

    @property
    def name(self) -> str:
        """`seed 3`, `seeds 0..4`."""
        if len(self.seeds) == 1:
            return f"seed {self.seeds[0]}"
        return f"seeds {self.seeds[0]}..{self.seeds[-1]}"

    @property
    def steps_per_second(self) -> float | None:
        """Environment steps a second over the last iterations, all seeds of the job together."""
        if len(self._marks) < 2:
            return None
        (begin, _, first), (end, _, last) = self._marks[0], self._marks[-1]
        return (last - first) * len(self.seeds) / max(end - begin, 1e-9)

    @property
    def seconds_left(self) -> float | None:
        """Expected time to the last iteration."""
        if len(self._marks) < 2:
            return None
        (begin, first, _), (end, last, _) = self._marks[0], self._marks[-1]
        return (end - begin) / max(last - first, 1) * (self.iterations - self.iteration)

    def cells(self) -> tuple[str, ...]:
        """Seeds, iteration, steps, speed, last evaluation, time left."""
        speed, left = self.steps_per_second, self.seconds_left
        training = self.status == "training"
        return (
            self.name,
            f"{self.iteration}/{self.iterations}",
            f"{self.env_steps:,} steps",
            f"{speed:,.0f} steps/s" if speed is not None and training else "",
            "" if self.evaluation_return is None else f"return {self.evaluation_return:.4g}",
            f"{duration(left)} left" if left is not None and training else self.status,
        )


def duration(seconds: float) -> str:
    """`0:04:09`."""
    minutes, whole = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{whole:02d}"


class Progress:
    """Lines that stay in place on a terminal; elsewhere a plain line a job now and then."""

    def __init__(self, jobs: Sequence[JobProgress]) -> None:
        self._jobs = jobs
        self._live: Live | None = None
        self._printed: dict[int, tuple[float, Status]] = {}

    def __enter__(self) -> Self:
        if sys.stderr.isatty():
            from rich.console import Console
            from rich.live import Live

            self._live = Live(
                console=Console(stderr=True), get_renderable=self._table, refresh_per_second=4, transient=True
            )
            self._live.__enter__()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._live:
            with suppress(OSError):  # a terminal that is gone
                self._live.__exit__(kind, error, trace)

    def note(self, line: str) -> None:
        """A line for the user that stays."""
        if self._live is None:
            tell(line)
            return
        try:
            self._live.console.print(line, highlight=False, markup=False, soft_wrap=True)
        except OSError:
            silence(sys.stderr)

    def show(self) -> None:
        """Print what is new where lines cannot stay in place."""
        if self._live:
            return
        now = time.monotonic()
        for index, job in enumerate(self._jobs):
            last, status = self._printed.get(index, (now, "waiting"))
            self._printed.setdefault(index, (last, status))
            changed = job.status != status and job.status not in ("waiting", "starting")
            if changed or (job.status == "training" and now - last >= _PLAIN_EVERY_S):
                self.note("  ".join(cell for cell in job.cells() if cell))
                self._printed[index] = (now, job.status)

    def _table(self) -> "Table":
        from rich.table import Table

        table = Table.grid(padding=(0, 2))
        table.add_column()
        for _ in range(5):
            table.add_column(justify="right")
        active = [job for job in self._jobs if job.status in ("starting", "training")]
        for job in active:
            table.add_row(*job.cells())
        ended = sum(job.status in ("finished", "stopped", "failed") for job in self._jobs)
        table.add_row(f"{ended} of {len(self._jobs)} ended")
        return table
