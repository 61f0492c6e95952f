"""What one job reports goes into the runs of its seeds."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from headway.events import (
    CheckpointSaved,
    EvaluationFinished,
    Event,
    Failed,
    Finished,
    IterationFinished,
    Row,
    Started,
)

if TYPE_CHECKING:
    from headway.energy.ledger import JobUsage
    from headway.store.folder import Status
    from headway.store.session import Run

TRACEBACK = "traceback.txt"
"""File in the folder of a run that failed."""


@dataclass
class JobRecording:
    """The runs of one job, one a seed, and what their training has used so far."""

    runs: Sequence["Run"]
    uses_gpu: bool = False
    before: Sequence[Mapping[str, Any]] = ()
    """Summaries of earlier sessions that trained these runs, one a seed; empty for new ones."""
    env_steps: int = 0
    """Environment steps of each seed, those before a resume included."""
    cpu_seconds: float = 0.0
    """Of this session, all seeds of the job together."""
    memory_bytes: int = 0
    process_ids: tuple[int, ...] = ()
    status: "Status" = "RUNNING"
    failure: Failed | None = None
    _first: tuple[float, int] | None = None
    _last: tuple[float, int] | None = None

    def take(self, event: Event) -> None:
        """Write an event into the runs. Raises HeadwayError if the store cannot be written."""
        match event:
            case Started(process_ids=process_ids):
                self.process_ids = process_ids
            case IterationFinished():
                self.env_steps, self.cpu_seconds = event.env_steps, event.cpu_seconds
                self.memory_bytes = event.memory_bytes
                # The training process's own clock: events may wait while the session is busy.
                self._last = (float(event.curve[0]["wall_s"]), event.env_steps)
                self._first = self._first or self._last
                self._points(event.curve)
            case EvaluationFinished(curve=curve):
                self._points(curve)
            case CheckpointSaved(iteration=iteration):
                for run in self.runs:
                    run.durable(iteration)
            case Finished(stopped=stopped):
                self.status = "KILLED" if stopped else "FINISHED"
            case Failed():
                self.status, self.failure = "FAILED", event
                self._keep_traceback(event)

    @property
    def usage(self) -> "JobUsage":
        """What energy is shared out by."""
        from headway.energy.ledger import JobUsage

        return JobUsage(
            self.cpu_seconds,
            self.memory_bytes,
            uses_gpu=self.uses_gpu,
            process_ids=self.process_ids,
        )

    @property
    def steps_per_second(self) -> float | None:
        """Environment steps a second of each seed, from the end of the first iteration to the last."""
        if self._first is None or self._last is None or self._last == self._first:
            return None
        (begin, first), (end, last) = self._first, self._last
        return (last - first) / max(end - begin, 1e-9)

    def _points(self, curve: Sequence[Row]) -> None:
        for run, row in zip(self.runs, curve, strict=True):
            run.points([row])

    def _keep_traceback(self, failure: Failed) -> None:
        for run in self.runs:
            text = failure.traceback or failure.line
            (run.directory / TRACEBACK).write_text(text + "\n", encoding="utf-8")
