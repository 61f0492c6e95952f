"""A job of a session, from its plan to the stored runs of its seeds."""

from dataclasses import dataclass, field, replace
from pathlib import Path

from headway.events import Event
from headway.store.run_folder import Status
from headway.training.loop import TrainingJob
from headway_launch.console.output import relative
from headway_launch.console.progress import ACTIVE, JobProgress
from headway_launch.runner.cell import SessionCell
from headway_launch.runner.cores import CoreShares, uses_gpu, workers_of
from headway_launch.runner.jobs import PlannedJob
from headway_launch.runner.recorder import TRACEBACK, JobRecorder

_MAX_RESTARTS = 3
"""Restarts of a lost training process from one checkpoint; at the next loss its runs fail."""


@dataclass
class SessionJob:
    """One stack of seeds in a session; `progress.status` is the current state of the job."""

    cell: SessionCell
    planned: PlannedJob
    progress: JobProgress
    recorder: JobRecorder | None = None
    """Recorder of its runs; None before they are created or reopened."""
    elsewhere: tuple[Path, ...] = ()
    """Folders of runs of its seeds that other sessions train or have finished, so that it does not start."""
    lost_at: list[int] = field(default_factory=list)
    """Last durable iteration at each loss of the training process."""

    @classmethod
    def of(cls, cell: SessionCell, planned: PlannedJob) -> "SessionJob":
        """Return a planned job, waiting to start."""
        config = cell.config
        progress = JobProgress(
            planned.seeds,
            planned.training.pause_after or config.iterations,
            config.evaluation.modes[0],
            iteration=planned.iteration,
            iteration_steps=config.iteration_steps,
            label=cell.plan.label,
        )
        return cls(cell, planned, progress)

    @property
    def account(self) -> str:
        """Name of the job's account in the energy meter, a new one per restart: counters begin at 0 again."""
        return f"{id(self)} {len(self.lost_at)}"

    @property
    def stored_status(self) -> Status:
        """Status of its runs in the store; a job that was stopped or never started was killed."""
        ended: dict[str, Status] = {"finished": "FINISHED", "failed": "FAILED"}
        return "RUNNING" if self.progress.status in ACTIVE else ended.get(self.progress.status, "KILLED")

    @property
    def has_no_runs(self) -> bool:
        """Whether no session has created runs of its seeds."""
        return self.recorder is None and not self.planned.resumed and not self.elsewhere

    def create_runs(self, shares: CoreShares) -> JobRecorder:
        """Create or reopen the stored runs. Raises HeadwayError as `SessionCell.runs` does."""
        runs = self.cell.runs(self.planned, shares)
        before = [run.energy.last() for run in runs] if self.planned.resumed else []
        self.recorder = JobRecorder(runs, uses_gpu=uses_gpu(self.planned), before=before)
        if not self.cell.plan.temporary:
            self.progress.traceback = f"{relative(runs[0].directory)}/{TRACEBACK}"
        return self.recorder

    def begin(self, shares: CoreShares) -> TrainingJob:
        """Create or reopen the stored runs and return the work of the training process."""
        return self.cell.training_job(self.planned, self.create_runs(shares).runs, shares)

    def take(self, event: Event) -> None:
        """Update progress and stored runs. Raises HeadwayError if the store cannot be written."""
        self.progress.take(event)
        if self.recorder is not None:
            self.recorder.take(event)

    def can_restart(self) -> bool:
        """Return whether a job whose training process was lost is started again.

        False after `_MAX_RESTARTS` restarts from the same checkpoint.
        """
        recorder = self.recorder
        return recorder is not None and self.lost_at.count(recorder.saved_iteration) < _MAX_RESTARTS

    def plan_restart(self, shares: CoreShares) -> None:
        """Plan to resume the runs, whose training process was lost, from their last checkpoint."""
        assert self.recorder is not None
        durable, runs = self.recorder.saved_iteration, self.recorder.runs
        self.lost_at.append(durable)
        self.planned = replace(
            self.planned,
            resumed=tuple(run.run_id for run in runs),
            iteration=durable,
            workers=workers_of(self.planned, shares),
        )
        self.recorder, self.progress.traceback = None, ""
