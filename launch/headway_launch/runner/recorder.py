"""Recording of a job's events in the stored runs of its seeds."""

import time
from collections.abc import Sequence
from dataclasses import dataclass, field

from headway.contracts.errors import HeadwayError
from headway.energy.ledger import Energy, JobUsage
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
from headway.store.session import Run
from headway_launch.console.output import print_line

TRACEBACK = "traceback.txt"
"""Name of the file, in the folder of a failed run, that holds the traceback."""
_MEASURED_SHARE = 0.99
"""Least share of a run's CPU seconds that is measured where a run has an energy: a session can be too short
for a reading."""


@dataclass
class JobRecorder:
    """The stored runs of one job, one per seed, and the resources that their training has used so far."""

    runs: Sequence[Run]
    uses_gpu: bool = False
    before: Sequence[Row] = ()
    """Last energy sample of each seed from earlier sessions; empty for new runs."""
    used: Usage = field(default_factory=Usage)
    """Resources used in this session by all seeds of the job."""
    process_ids: tuple[int, ...] = ()
    began: float | None = None
    """When training began, on the session's monotonic clock."""
    trained_s: float = 0.0
    """Seconds from the beginning to the end of training; 0 if the process ended without a final event."""
    store_s: float = 0.0
    """Seconds of `trained_s` spent on logs and checkpoints."""
    failure: Failed | None = None

    def take(self, event: Event) -> None:
        """Write an event into the runs. Raises HeadwayError if the store cannot be written."""
        match event:
            case Started(iteration=iteration, process_ids=process_ids):
                self.process_ids, self.began = process_ids, time.monotonic()
                if event.episodes_restarted:
                    for run in self.runs:
                        run.note_restart(iteration)
            case IterationFinished(usage=usage) | EvaluationFinished(usage=usage):
                self.used = usage
            case CheckpointSaved(iteration=iteration):
                for run in self.runs:
                    run.durable(iteration)
            case Finished(usage=usage):
                self.used = usage or self.used
                if self.began is not None and usage is not None:
                    self.trained_s, self.store_s = time.monotonic() - self.began, event.store_s
                self._record_checkpoint()
            case Failed():
                self.failure = event
                self._record_checkpoint()
                self._keep_traceback(event)

    @property
    def usage(self) -> JobUsage:
        """Resource use by which the energy meter divides energy among jobs."""
        return JobUsage(self.used.cpu_seconds, self.used.memory_bytes, self.uses_gpu, self.process_ids)

    def keep_energy(self, moment: float, energy: Energy) -> Sequence[Row]:
        """Store an energy sample in each run and return the samples, one per seed.

        A sample is the seed's equal share of the job's `energy` in this session plus its use in earlier ones,
        and the run's wall time, which is known also where energy is not measured. A part of the energy that
        one of these sessions did not measure is left out: the rest is not the run's energy.
        `moment`: seconds since the epoch.
        """
        seeds = len(self.runs)
        share = {**energy.per_seed(seeds).as_row(), "cpu_seconds": self.used.cpu_seconds / seeds}
        samples = []
        for run, before in zip(self.runs, self.before or (dict[str, float](),) * seeds, strict=True):
            earlier = {name: float(value) for name, value in before.items() if name != "time"}
            sums = {}
            for name in {**earlier, **share}:
                measured = [session for session in (earlier, share) if name in session]
                covered = sum(session.get("cpu_seconds", 0.0) for session in measured)
                if covered >= _MEASURED_SHARE * (earlier.get("cpu_seconds", 0.0) + share["cpu_seconds"]):
                    sums[name] = sum(session[name] for session in measured)
            samples.append({"time": moment, **sums, "duration_s": run.duration_s})
            run.energy.append(samples[-1])
        return samples

    @property
    def saved_iteration(self) -> int:
        """Iteration of the newest checkpoint on disk; 0 if there is none."""
        # Every seed's checkpoint contains the whole stack, so the newest in any of the folders counts.
        return max(latest_iteration(run.directory / CHECKPOINTS) or 0 for run in self.runs)

    def _record_checkpoint(self) -> None:
        """Record the newest checkpoint on disk, which a killed process may not have reported."""
        saved = self.saved_iteration
        for run in self.runs:
            if saved > run.record.durable_iteration:
                run.durable(saved)

    def _keep_traceback(self, failure: Failed) -> None:
        for run in self.runs:
            text = failure.traceback or failure.line
            try:
                write_text(run.directory / TRACEBACK, text + "\n")
            except HeadwayError as error:  # an error here must not end the other jobs
                print_line(f"headway: {error}")
