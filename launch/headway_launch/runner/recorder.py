"""What one job reports goes into the runs of its seeds."""

import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from headway.contracts.errors import HeadwayError
from headway.events import (
    CheckpointSaved,
    EvaluationFinished,
    Event,
    Failed,
    Finished,
    IterationFinished,
    Row,
    Started,
    Usage,
)
from headway.store.atomic_files import write_text
from headway.store.checkpoint import latest_iteration
from headway.store.run_folder import CHECKPOINTS
from headway_launch.console.output import print_line

if TYPE_CHECKING:
    from headway.energy.ledger import Energy, JobUsage
    from headway.store.run_folder import Status
    from headway.store.session import Run

TRACEBACK = "traceback.txt"
"""File in the folder of a run that failed."""


@dataclass
class JobRecorder:
    """The runs of one job, one a seed, and what their training has used so far."""

    runs: Sequence["Run"]
    uses_gpu: bool = False
    before: Sequence[Row] = ()
    """Last energy samples of earlier sessions that trained these runs, one a seed; empty for new ones."""
    env_steps: int = 0
    """Environment steps of each seed, those before a resume included."""
    used: Usage = field(default_factory=Usage)
    """In this session, all seeds of the job together."""
    process_ids: tuple[int, ...] = ()
    began: float | None = None
    """When training began, on the session's monotonic clock."""
    trained_s: float = 0.0
    """How long it went on; 0 where its process could not tell of its end."""
    store_s: float = 0.0
    """Seconds of that on the log and checkpoints."""
    status: "Status" = "RUNNING"
    failure: Failed | None = None
    _first: tuple[float, int] | None = None
    _last: tuple[float, int] | None = None

    def take(self, event: Event) -> None:
        """Write an event into the runs. Raises HeadwayError if the store cannot be written."""
        match event:
            case Started(iteration=iteration, process_ids=process_ids):
                self.process_ids, self.began = process_ids, time.monotonic()
                if event.episodes_restarted:
                    for run in self.runs:
                        run.note_restart(iteration)
            case IterationFinished():
                self.env_steps, self.used = event.env_steps, event.usage
                # The training process's own clock: events may wait while the session is busy.
                self._last = (float(event.curve[0]["wall_s"]), event.env_steps)
                self._first = self._first or self._last
                self._points(event.curve)
            case EvaluationFinished(usage=usage, curve=curve):
                self.used = usage
                self._points(curve)
            case CheckpointSaved(iteration=iteration):
                for run in self.runs:
                    run.durable(iteration)
            case Finished(stopped=stopped, usage=usage):
                self.used = usage or self.used
                if self.began is not None and usage is not None:
                    self.trained_s, self.store_s = time.monotonic() - self.began, event.store_s
                self.status = "KILLED" if stopped else "FINISHED"
                self._find_checkpoint()
            case Failed():
                self.status, self.failure = "FAILED", event
                self._find_checkpoint()
                self._keep_traceback(event)

    @property
    def usage(self) -> "JobUsage":
        """What energy is shared out by."""
        from headway.energy.ledger import JobUsage

        return JobUsage(
            self.used.cpu_seconds,
            self.used.memory_bytes,
            uses_gpu=self.uses_gpu,
            process_ids=self.process_ids,
        )

    def keep_energy(self, moment: float, energy: "Energy") -> Sequence[Row]:
        """Give each run a sample of what its training has used by `moment` (seconds since 1970), over all
        sessions, where `energy` is the job's in this one; the samples, one a seed."""
        seeds = len(self.runs)
        share = {**energy.per_seed(seeds).as_row(), "cpu_seconds": self.used.cpu_seconds / seeds}
        samples = []
        for run, before in zip(self.runs, self.before or (dict[str, float](),) * seeds, strict=True):
            earlier = {name: float(value) for name, value in before.items() if name != "time"}
            sums = {name: earlier.get(name, 0.0) + share.get(name, 0.0) for name in {**earlier, **share}}
            samples.append({"time": moment, **sums})
            run.energy(samples[-1])
        return samples

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

    def _find_checkpoint(self) -> None:
        """A process killed at once may not have told of its last checkpoint; any seed's is the stack's."""
        saved = max(latest_iteration(run.directory / CHECKPOINTS) or 0 for run in self.runs)
        for run in self.runs:
            if saved > run.record.durable_iteration:
                run.durable(saved)

    def _keep_traceback(self, failure: Failed) -> None:
        for run in self.runs:
            text = failure.traceback or failure.line
            try:
                write_text(run.directory / TRACEBACK, text + "\n")
            except HeadwayError as error:  # it must not end the other jobs
                print_line(f"headway: {error}")
