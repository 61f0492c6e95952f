"""Execution of a session: stored runs, training, energy measurement, rule episodes, results table."""

import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from headway.config.experiment import ExperimentConfig
from headway.energy import EnergyMeter, EnergyReport
from headway.events import Event
from headway.rollout.workers.usage import usable_cores
from headway.store import CHECKPOINTS, Status
from headway.store.checkpoint import latest_iteration
from headway.store.session import SessionStore
from headway.training.loop import TrainingJob
from headway.wording import counted
from headway_launch.console.output import ignore_closed_pipe, own_name, print_line
from headway_launch.console.progress import JobProgress
from headway_launch.experiments.parameters import session_settings
from headway_launch.runner.cell import Rules, SessionCell
from headway_launch.runner.cluster.ray_cluster import SessionCluster
from headway_launch.runner.cores import uses_gpu, workers_of
from headway_launch.runner.jobs import CellPlan, PlannedJob, require_free_disk
from headway_launch.runner.recorder import TRACEBACK, JobRecorder
from headway_launch.runner.results import print_cells, print_results, seed_result
from headway_launch.runner.scheduler import Scheduler
from headway_launch.runner.warm_up import compile_kernels_of

EXIT_DONE, EXIT_FAILED, EXIT_STOPPED = 0, 2, 130
_MAX_RESTARTS = 3
"""Restarts of a lost training process from one checkpoint; at the next loss its runs fail."""
_MAX_LISTED_RUNS = 3
_SHORTEST_MEASURED_S = 60.0
"""Training seconds from which the store's share is printed; in less, start-up and shutdown dominate."""
STORE_SHARE = "storage took"
"""Prefix of the line that reports the store's share of the training time."""


@dataclass
class _Job:
    cell: SessionCell
    planned: PlannedJob
    progress: JobProgress
    recording: JobRecorder | None = None
    lost_at: list[int] = field(default_factory=list)
    """Last durable iteration at each loss of the training process."""

    @property
    def account(self) -> str:
        """Name of the job's account in the energy meter, a new one per restart: counters begin at 0 again."""
        return f"{id(self)} {len(self.lost_at)}"


class Runner:
    """Trains the cells of one session with one store and one energy meter, jobs of all cells in parallel.

    Raises HeadwayError before anything starts if the store cannot be used.

    `plan_kept`: the study stores its plan, so runs that never start need no folder.
    """

    def __init__(self, cells: Sequence[CellPlan], debug: bool = False, plan_kept: bool = False) -> None:
        self._config: ExperimentConfig = cells[0].experiment.config
        self._debug, self._plan_kept = debug, plan_kept
        self._own_cpu_s = 0.0
        """CPU seconds of this process since training began, without those spent on rule episodes."""
        planned = [job for cell in cells for job in cell.jobs]
        self._cluster = SessionCluster.open([job.config.backend for job in planned])
        try:
            self._shares = self._cluster.share_cores(self._config.backend, planned, usable_cores())
            require_free_disk(Path(self._config.store.root), planned, self._shares.parallel)
            compile_kernels_of([cell.experiment for cell in cells if cell.jobs])
            self._store = SessionStore.open(self._config.store)
            self._cells = [SessionCell(self._store, cell) for cell in cells]
            self._jobs = [
                _Job(cell, job, _progress_of(cell, job)) for cell in self._cells for job in cell.plan.jobs
            ]
            self._meter = EnergyMeter.start(self._config.energy) if planned else None
        except BaseException:
            self._cluster.close()
            raise
        self._sampled = time.monotonic()

    def run(self) -> int:
        """Train, evaluate the rules and print the results; return the exit code."""
        began, self._own_cpu_s = time.monotonic(), -time.process_time()
        scheduler = Scheduler(
            [job.progress for job in self._jobs],
            self._shares.parallel,
            self._begin,
            self._take,
            self._tick,
            self._cluster.open_training,
            self._should_restart,
        )
        try:
            stopped = scheduler.run()
            self._store_unstarted(stopped)
            played: dict[str, Rules] = {}
            rules_from = time.thread_time()
            for cell in self._cells if not stopped else ():
                cell.play_rules(played)
            self._own_cpu_s -= time.thread_time() - rules_from
        finally:
            self._end_cells()
            for line in (*(self._meter.notices() if self._meter else ()), *self._store.close()):
                print_line(f"headway: {line}")
            self._cluster.close()
        self._own_cpu_s += time.process_time()
        with ignore_closed_pipe(sys.stdout):
            self._print()
        self._print_summary(time.monotonic() - began)
        return self._exit_code(stopped)

    def final_rewards(self) -> list[list[float]]:
        """Return the final rewards of the finished seeds, one list per cell."""
        return [
            [
                result.final_reward
                for result in cell.results
                if result.status == "FINISHED" and result.final_reward is not None
            ]
            for cell in self._cells
        ]

    def _begin(self, index: int) -> TrainingJob:
        """Create or resume the runs of a job and return the work of its training process."""
        job = self._jobs[index]
        runs = job.cell.runs(job.planned, self._shares)
        before = [run.energy_so_far for run in runs] if job.planned.resumed else []
        job.recording = JobRecorder(runs, uses_gpu=uses_gpu(job.planned), before=before)
        job.progress.traceback = f"{_relative(str(runs[0].directory))}/{TRACEBACK}"
        training = job.cell.training_job(job.planned, runs, self._shares)
        backend = self._cluster.backend(training.config.backend)
        return replace(training, config=replace(training.config, backend=backend))

    def _take(self, index: int, event: Event) -> None:
        job = self._jobs[index]
        if job.recording is None:  # failed before its runs were created
            return
        job.recording.take(event)
        if job.recording.status != "RUNNING":
            self._finish(job, job.recording)
            if self._debug and job.recording.failure:
                print_line(job.recording.failure.traceback)

    def _should_restart(self, index: int) -> bool:
        """Return whether to restart a job whose training process was lost, and plan its resumption if so.

        Its runs end as killed ones. False after `_MAX_RESTARTS` restarts from the same checkpoint.
        """
        job = self._jobs[index]
        if job.recording is None:
            return False
        runs = job.recording.runs
        durable = max(latest_iteration(run.directory / CHECKPOINTS) or 0 for run in runs)
        if job.lost_at.count(durable) == _MAX_RESTARTS:
            return False
        job.recording.status = "KILLED"
        self._finish(job, job.recording, in_results=False)
        job.lost_at.append(durable)
        job.recording, job.progress.traceback = None, ""
        job.planned = replace(
            job.planned,
            resumed=tuple(run.run_id for run in runs),
            iteration=durable,
            workers=workers_of(job.planned, self._shares),
        )
        return True

    def _tick(self) -> tuple[str, ...]:
        now = time.monotonic()
        if self._meter and now - self._sampled >= self._config.energy.interval_s:
            self._sampled = now
            self._sample_energy(self._meter)
        return (*self._store.notices(), *(self._meter.notices() if self._meter else ()))

    def _running(self) -> dict[str, JobRecorder]:
        return {
            job.account: job.recording
            for job in self._jobs
            if job.recording is not None and job.recording.status == "RUNNING"
        }

    def _sample_energy(self, meter: EnergyMeter) -> None:
        running = self._running()
        energies = meter.sample({name: recording.usage for name, recording in running.items()})
        for name, recording in running.items():
            recording.keep_energy(time.time(), energies[name])

    def _finish(self, job: _Job, recording: JobRecorder, in_results: bool = True) -> None:
        """End the runs of a job in the store; `in_results`: add them to the results table."""
        assert self._meter is not None
        cell = job.cell
        others = {name: other.usage for name, other in self._running().items()}
        energy = self._meter.finish(job.account, others, recording.usage)
        modes = self._meter.modes.as_tags() if self._config.energy.enabled else {}
        for run, used in zip(recording.runs, recording.keep_energy(time.time(), energy), strict=True):
            result = seed_result(run, recording, cell.config.evaluation.modes[0], used, modes)
            run.finish(recording.status, result.summary)
            if in_results:
                cell.results.append(result)

    def _store_unstarted(self, stopped: bool) -> None:
        """Store the runs that never started as killed, so that `headway resume` finds them."""
        for job in self._jobs:
            if stopped and job.recording is None and not job.planned.resumed and not self._plan_kept:
                job.recording = JobRecorder(job.cell.runs(job.planned, self._shares), status="KILLED")
                self._finish(job, job.recording)

    def _end_cells(self) -> None:
        metrics = _session_metrics(self._meter.stop()) if self._meter else {}
        for cell in self._cells:
            # Also cells without jobs: a killed session may have left them open in MLflow.
            statuses = [_status(job) for job in self._jobs if job.cell is cell]
            cell.finish(statuses, metrics if cell.touched else {})

    def _exit_code(self, stopped: bool) -> int:
        if stopped:
            return EXIT_STOPPED
        return EXIT_FAILED if any(_status(job) == "FAILED" for job in self._jobs) else EXIT_DONE

    def _print(self) -> None:
        if len(self._cells) == 1:
            [cell] = self._cells
            print_results(cell.config, cell.in_order(), cell.rules)
        else:
            print_cells(
                self._config.study,
                [(cell.plan.label, len(cell.config.seed), cell.in_order()) for cell in self._cells],
                {cell.config.evaluation.episodes for cell in self._cells},
            )

    def _print_summary(self, seconds: float) -> None:
        root, study = self._config.store.root, self._config.study
        results = [result for cell in self._cells for result in cell.results]
        folders = sorted({str(Path(result.directory).parent) for result in results})
        where = ", ".join(_relative(folder) for folder in folders)
        option = "" if root == type(self._config.store)().root else f" --store {root}"
        if where:
            print_line(
                f"{seconds:.0f} s; run folders in {where}; view them with: {own_name()} browse{option}"
            )
        if len(self._cells) > 1 and any(cell.rules for cell in self._cells):
            environments = {repr((cell.config.env.id, cell.config.env.args)) for cell in self._cells}
            command = "compare" if len(environments) == 1 else "report"
            print_line(f"compare with the rules, with intervals: {own_name()} {command} {study}{option}")
        self._print_store_share()
        unfinished = [result.run_id for result in results if result.status in ("KILLED", "FAILED")]
        not_started = sum(len(job.planned.seeds) for job in self._jobs if job.recording is None)
        if unfinished or not_started:
            named = (
                " ".join(unfinished)
                if len(unfinished) <= _MAX_LISTED_RUNS and not self._plan_kept
                else f"--study {study}"
            )
            waiting = f"{counted(not_started, 'run')} not started; " if not_started else ""
            print_line(f"headway: {waiting}to continue: {own_name()} resume {named}{option}")

    def _print_store_share(self) -> None:
        """Print the store's share of the training time, in the training processes and in this one."""
        recordings = [job.recording for job in self._jobs if job.recording is not None]
        trained = sum(recording.trained_s for recording in recordings)
        if trained >= _SHORTEST_MEASURED_S:
            kept, own = sum(recording.store_s for recording in recordings), self._own_cpu_s
            print_line(
                f"{STORE_SHARE} {(kept + own) / trained:.1%} of {trained:,.0f} s of training (logs and "
                f"checkpoints {kept:.1f} s, MLflow and energy {own:.1f} CPU s)"
            )


def run_sessions(cells: Sequence[CellPlan], debug: bool, plan_kept: bool = False) -> int:
    """Run cells in groups of equal session settings, one group after another; return the worst exit code."""
    sessions: dict[str, list[CellPlan]] = {}
    for cell in cells:
        sessions.setdefault(str(session_settings(cell.experiment.config)), []).append(cell)
    worst = EXIT_DONE
    for together in sessions.values():
        worst = max(worst, Runner(together, debug, plan_kept).run())
        if worst == EXIT_STOPPED:
            break
    return worst


def _progress_of(cell: SessionCell, job: PlannedJob) -> JobProgress:
    config = cell.config
    return JobProgress(
        job.seeds,
        config.iterations,
        config.evaluation.modes[0],
        iteration=job.iteration,
        iteration_steps=config.rollout.copies * config.rollout.steps,
        label=cell.plan.label,
    )


def _status(job: _Job) -> Status:
    """Return the status of a job; one that never started was killed unless it failed to start."""
    if job.recording is not None:
        return job.recording.status
    return "FAILED" if job.progress.status == "failed" else "KILLED"


def _session_metrics(report: EnergyReport) -> dict[str, float]:
    """Return the energy of the machine in kWh, and the parts of it that no run used (session and idle)."""
    parts = {"total": report.total, "session": report.session, "idle": report.idle}
    return {f"energy_{name}_kwh": part.kwh for name, part in parts.items() if part.kwh is not None}


def _relative(folder: str) -> str:
    path = Path(folder)
    return str(path.relative_to(Path.cwd())) if path.is_relative_to(Path.cwd()) else folder
