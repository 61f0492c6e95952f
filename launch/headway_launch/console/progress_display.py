"""Progress on stderr: a display updated in place on a terminal, occasional lines elsewhere."""

import sys
import time
from abc import ABC, abstractmethod
from collections.abc import Sequence
from contextlib import suppress
from typing import TYPE_CHECKING, Self

from headway_launch.console.output import print_line, silence, visible
from headway_launch.console.progress import (
    ACTIVE,
    ENDED,
    JobProgress,
    Status,
    counts,
    duration,
    overall,
    seeds_with,
)

if TYPE_CHECKING:
    from rich.console import RenderableType
    from rich.live import Live

_MOST_JOB_LINES = 4
"""Maximum number of jobs that get one plain line each; more jobs get one line in total."""
_PLAIN_EVERY_S, _PLAIN_AT_MOST_EVERY_S = 30.0, 600.0
_PLAIN_SHARE = 0.1
"""Pause between plain lines as a share of the elapsed time, so that they become rarer."""


class _InPlace(ABC):
    """Lines on stderr, updated in place on a terminal and cleared at the end."""

    def __init__(self) -> None:
        self._live: Live | None = None
        self._began = self._printed = time.monotonic()

    @abstractmethod
    def _screen(self, width: int, height: int) -> "RenderableType":
        """Return what a terminal of `width` columns and `height` rows shows."""

    def __enter__(self) -> Self:
        self._began = self._printed = time.monotonic()
        if sys.stderr.isatty():
            from rich.console import Console
            from rich.live import Live

            console = Console(stderr=True)

            def renderable() -> "RenderableType":
                return self._screen(console.width, console.height)

            self._live = Live(
                console=console, get_renderable=renderable, refresh_per_second=4, transient=True
            )
            self._live.__enter__()
        return self

    def __exit__(self, *error: object) -> None:
        if self._live:
            with suppress(OSError):  # closed terminal
                self._live.stop()

    def note(self, line: str) -> None:
        """Print a line that stays above the display."""
        line = " ".join(line.split())
        if self._live is None:
            print_line(line)
            return
        try:
            self._live.console.print(visible(line), highlight=False, markup=False, soft_wrap=True)
        except OSError:
            silence(sys.stderr)

    def _is_due(self) -> bool:
        """Return whether to print a plain line, because the last is long ago and there is no terminal."""
        now = time.monotonic()
        pause = min(max(_PLAIN_EVERY_S, _PLAIN_SHARE * (now - self._began)), _PLAIN_AT_MOST_EVERY_S)
        due = self._live is None and now - self._printed >= pause
        self._printed = now if due else self._printed
        return due


class Progress(_InPlace):
    """Progress of a session's jobs: lines updated in place on a terminal, at most as many as it has rows.

    Elsewhere it prints a plain line per job that starts or ends, and occasional lines on the total progress.
    """

    def __init__(self, jobs: Sequence[JobProgress], parallel: int = 1) -> None:
        super().__init__()
        self._jobs, self._parallel = jobs, parallel
        self._statuses: list[Status] = ["waiting" for _ in jobs]

    def show(self) -> None:
        """Print new statuses, and progress from time to time; no effect on a terminal."""
        if self._live:
            return
        for index, job in enumerate(self._jobs):
            if job.status != self._statuses[index] and job.status not in ("waiting", "starting"):
                self._statuses[index] = job.status
                self._print(job)
        if not self._is_due():
            return
        training = [job for job in self._jobs if job.status == "training"]
        for job in training if len(training) <= _MOST_JOB_LINES else ():
            self._print(job)
        if len(self._jobs) > 1:
            self.note(overall(self._jobs, self._parallel))

    def _screen(self, width: int, height: int) -> "RenderableType":
        """Return total, cells and running jobs; lines that do not fit are replaced by their number."""
        from rich.table import Table

        rows = max(height - 1, 3)
        screen = Table.grid()
        screen.add_column(no_wrap=True, overflow="ellipsis", max_width=width)
        active = [job for job in self._jobs if job.status in ACTIVE]
        labels = list(dict.fromkeys(job.label for job in self._jobs))
        lines = [overall(self._jobs, self._parallel)] if len(self._jobs) > 1 else []
        if len(labels) > 1:
            room = max(1, (rows - 1) // 2, rows - 1 - len(active))
            lines += _fitting([self._of_cell(label) for label in labels], room, "cells")
        lines += _fitting(_aligned([_cells(job, width) for job in active]), rows - len(lines), "training")
        for line in lines:
            screen.add_row(line)
        return screen

    def _of_cell(self, label: str) -> str:
        jobs = [job for job in self._jobs if job.label == label]
        returns = [job.evaluation_return for job in jobs if job.evaluation_return is not None]
        mean = f", return {sum(returns) / len(returns):.4g}" if returns else ""
        seeds = sum(len(job.seeds) for job in jobs)
        ended = f"{label}: {seeds_with(jobs, *ENDED)} of {seeds} ended"
        return ", ".join([ended, *counts(jobs, "failed", "paused", "stopped")]) + mean

    def _print(self, job: JobProgress) -> None:
        self.note("  ".join(cell for cell in job.cells() if cell))


class CountedProgress(_InPlace):
    """Progress of counted work of known or unknown length: one line in place, elsewhere occasional lines."""

    def __init__(self, what: str, total: int | None = None) -> None:
        """`what`: the counted work, such as `days simulated`."""
        super().__init__()
        self._what, self._total, self._done, self._remark = what, total, 0, ""

    def add(self, count: int = 1, remark: str = "") -> None:
        """Count `count` more; `remark` names the current work if a single unit takes long."""
        self._done, self._remark = self._done + count, f" ({remark})" if remark else ""
        if self._is_due():
            print_line(self.line)

    def _screen(self, width: int, height: int) -> "RenderableType":
        from rich.text import Text

        return Text(self.line, no_wrap=True, overflow="ellipsis")

    @property
    def line(self) -> str:
        """`days simulated: 3 of 20, about 0:01:20 left (remark)`, or `steps played: 412` without a total."""
        if self._total is None:
            return f"{self._what}: {self._done:,}{self._remark}"
        counted = f"{self._what}: {self._done:,} of {self._total:,}"
        if not 0 < self._done < self._total:
            return f"{counted}{self._remark}"
        left = (time.monotonic() - self._began) / self._done * (self._total - self._done)
        return f"{counted}, about {duration(left)} left{self._remark}"


def _cells(job: JobProgress, width: int) -> tuple[str, ...]:
    """Return the table cells of a job; narrow lines omit the steps, which follow from the iterations."""
    name, iteration, steps, *others = job.cells()
    return (name, iteration, *((steps,) if width >= 100 else ()), *others)


def _aligned(rows: Sequence[tuple[str, ...]]) -> list[str]:
    """Align columns: names to the left, numbers to the right."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return [
        "  ".join(
            cell.ljust(width) if place == 0 else cell.rjust(width)
            for place, (cell, width) in enumerate(zip(row, widths, strict=True))
            if width
        )
        for row in rows
    ]


def _fitting(lines: list[str], room: int, kind: str) -> list[str]:
    if len(lines) <= room:
        return lines
    shown = max(room - 1, 0)
    return [*lines[:shown], f"... and {len(lines) - shown} more {kind}"][:room]
