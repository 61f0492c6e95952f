"""An experiment from plan to table: runs in the store, training, energy, the rules, the result."""

import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import fmean

from headway.config import ExperimentConfig
from headway.energy import EnergyMeter, EnergyReport
from headway.events import Event, Row
from headway.store import CHECKPOINTS, Status
from headway.store.checkpoint import latest_iteration
from headway.store.provenance import usable_cores
from headway.store.session import Cell, Run, SessionStore
from headway.training import TrainingJob
from headway_launch.comparison import rule_episodes
from headway_launch.kernels import compile_kernels
from headway_launch.planning import (
    PlannedJob,
    Shares,
    cell_parameters,
    full_mapping,
    require_free_disk,
    share_cores,
    workers_of,
)
from headway_launch.progress import JobProgress
from headway_launch.recording import TRACEBACK, JobRecording
from headway_launch.results import SeedResult, print_results, seed_result
from headway_launch.session import Session
from headway_launch.telling import own_name, tell, to_a_reader

EXIT_DONE, EXIT_FAILED, EXIT_STOPPED = 0, 2, 130
_NAMED_RUNS = 3


@dataclass
class _Job:
    planned: PlannedJob
    progress: JobProgress
    recording: JobRecording | None = None


class Conductor:
    """Conducts planned jobs of one experiment to their end. Raises HeadwayError before anything starts if
    the store cannot be used."""

    def __init__(self, jobs: Sequence[PlannedJob], debug: bool = False) -> None:
        self._experiment = jobs[0].experiment
        self._config: ExperimentConfig = self._experiment.config
        self._debug = debug
        mode = self._config.evaluation.modes[0]
        self._jobs = [_Job(job, JobProgress(job.seeds, self._config.iterations, mode)) for job in jobs]
        self._shares: Shares = share_cores(
            self._config.backend, len(jobs), usable_cores(), max(job.workers or 1 for job in jobs)
        )
        seeds = sum(len(job.seeds) for job in jobs)
        require_free_disk(Path(self._config.store.root), seeds)
        compile_kernels(self._experiment.env)
        self._store = SessionStore.open(self._config.store)
        self._cell: Cell = self._store.begin_cell(
            self._config.study,
            self._config.env.id,
            self._experiment.algo_name,
            cell_parameters(self._experiment),
        )
        self._meter = EnergyMeter.start(self._config.energy)
        self._sampled = time.monotonic()
        self._results: list[SeedResult] = []

    def conduct(self) -> int:
        """Train, evaluate the rules, print the table; returns the exit code."""
        began = time.monotonic()
        rules: dict[str, list[Row]] = {}
        session = Session(
            [job.progress for job in self._jobs], self._shares.parallel, self._begin, self._take, self._tick
        )
        try:
            stopped = session.run()
            self._finish_jobs(stopped)
            rules = {} if stopped else self._rules()
            self._cell.keep_rules(rules)
        finally:
            report = self._meter.stop()
            self._cell.finish(self._status(), {**_session_figures(report), **_rule_figures(rules)})
            for line in (*self._meter.notices(), *self._store.close()):
                tell(f"headway: {line}")
        with to_a_reader(sys.stdout):
            print_results(self._config, self._results, rules)
        self._say_where(time.monotonic() - began)
        return self._exit_code(stopped)

    def final_rewards(self) -> list[float]:
        """The final reward of each finished seed."""
        return [
            result.final_reward
            for result in self._results
            if result.status == "FINISHED" and result.final_reward is not None
        ]

    def _begin(self, index: int) -> TrainingJob:
        """The runs of a job, made or taken up again, and what its training process is given."""
        job = self._jobs[index]
        runs = self._runs(job.planned)
        before = [run.energy_so_far for run in runs] if job.planned.resumed else []
        job.recording = JobRecording(runs, uses_gpu=_uses_gpu(self._config.device), before=before)
        experiment, planned = self._experiment, job.planned
        with_checkpoint = any(_has_checkpoint(run.directory) for run in runs)
        return TrainingJob(
            make_env=experiment.env.make,
            preload=experiment.env.preload,
            prepared=planned.prepared,
            spec=planned.spec,
            make_policy=experiment.algo.acting_policy,
            make_learner=experiment.algo.learner,
            algo_config=experiment.algo_config,
            seeds=planned.seeds,
            config=replace(self._config, seed=planned.seeds),
            workers=workers_of(planned, self._shares),
            directories=tuple(str(run.directory) for run in runs),
            resume=bool(planned.resumed) and with_checkpoint,
            training_prepared=planned.training_prepared,
        )

    def _runs(self, planned: PlannedJob) -> list[Run]:
        if planned.resumed:
            return [self._store.resume(run_id) for run_id in planned.resumed]
        import yaml

        plan = {
            "stack": list(planned.seeds),
            "rollout": full_mapping(self._experiment, ())["rollout"],
            "workers": workers_of(planned, self._shares),
        }
        return [
            self._cell.begin_run(
                seed,
                yaml.safe_dump(full_mapping(self._experiment, [seed]), sort_keys=False),
                plan,
                iterations=self._config.iterations,
                policies=str(getattr(self._experiment.algo_config, "policies", "")),
            )
            for seed in planned.seeds
        ]

    def _take(self, index: int, event: Event) -> None:
        job = self._jobs[index]
        if job.recording is None:  # it failed before it had a run
            return
        job.recording.take(event)
        if job.recording.status != "RUNNING":
            self._finish(index, job.recording)
            if self._debug and job.recording.failure:
                tell(job.recording.failure.traceback)

    def _tick(self) -> tuple[str, ...]:
        now = time.monotonic()
        if now - self._sampled >= self._config.energy.interval_s:
            self._sampled = now
            self._sample_energy()
        return (*self._store.notices(), *self._meter.notices())

    def _running(self) -> dict[str, JobRecording]:
        return {
            str(index): job.recording
            for index, job in enumerate(self._jobs)
            if job.recording is not None and job.recording.status == "RUNNING"
        }

    def _sample_energy(self) -> None:
        running = self._running()
        energies = self._meter.sample({name: recording.usage for name, recording in running.items()})
        for name, recording in running.items():
            recording.keep_energy(time.time(), energies[name])

    def _finish(self, index: int, recording: JobRecording) -> None:
        others = {name: other.usage for name, other in self._running().items()}
        energy = self._meter.finish(str(index), others, recording.usage)
        modes = self._meter.modes.as_tags() if self._config.energy.enabled else {}
        for run, used in zip(recording.runs, recording.keep_energy(time.time(), energy), strict=True):
            result = seed_result(run, recording, self._config.evaluation.modes[0], used, modes)
            run.finish(recording.status, result.summary)
            self._results.append(result)

    def _finish_jobs(self, stopped: bool) -> None:
        """Put down the runs that never began, so that `headway resume` finds them; put the seeds in order."""
        for index, job in enumerate(self._jobs):
            if stopped and job.recording is None and not job.planned.resumed:
                job.recording = JobRecording(self._runs(job.planned), status="KILLED")
                self._finish(index, job.recording)
        order = {seed: place for place, seed in enumerate(self._config.seed)}
        self._results.sort(key=lambda result: order.get(result.seed, 0))

    def _status(self) -> Status:
        """FINISHED if every job has; FAILED if one has failed."""
        statuses = {job.recording.status if job.recording else "FAILED" for job in self._jobs}
        if "FAILED" in statuses:
            return "FAILED"
        return "FINISHED" if statuses == {"FINISHED"} else "KILLED"

    def _rules(self) -> dict[str, list[Row]]:
        if not any(result.status == "FINISHED" for result in self._results):
            return {}
        evaluation = self._config.evaluation
        days, prepared = evaluation.last_episodes, self._jobs[0].planned.prepared
        return rule_episodes(self._experiment, prepared, self._experiment.rules, evaluation.seed, days)

    def _exit_code(self, stopped: bool) -> int:
        if stopped:
            return EXIT_STOPPED
        return EXIT_FAILED if self._status() == "FAILED" else EXIT_DONE

    def _say_where(self, seconds: float) -> None:
        root = self._config.store.root
        folders = sorted({str(Path(result.directory).parent) for result in self._results})
        where = ", ".join(_from_here(folder) for folder in folders)
        option = "" if root == type(self._config.store)().root else f" --store {root}"
        if where:
            tell(f"{seconds:.0f} s; run folders in {where}; look at them with: {own_name()} browse{option}")
        for result in self._results:
            if result.status == "FAILED":
                tell(f"headway: seed {result.seed}: see {_from_here(result.directory)}/{TRACEBACK}")
        unfinished = [result.run_id for result in self._results if result.status in ("KILLED", "FAILED")]
        if unfinished:
            named = (
                " ".join(unfinished) if len(unfinished) <= _NAMED_RUNS else f"--study {self._config.study}"
            )
            tell(f"headway: to go on: {own_name()} resume {named}{option}")


def _session_figures(report: EnergyReport) -> dict[str, float]:
    """What the machine used, and the parts of it that are no run's."""
    parts = {"total": report.total, "session": report.session, "idle": report.idle}
    return {f"energy_{name}_kwh": part.kwh for name, part in parts.items() if part.kwh is not None}


def _uses_gpu(device: str) -> bool:
    return device.startswith("cuda") or (device == "auto" and Path("/dev/nvidiactl").exists())


def _rule_figures(rules: Mapping[str, Sequence[Row]]) -> dict[str, float]:
    return {
        f"rules/{rule.replace('.', '_')}_return": fmean(float(row["return"]) for row in rows)
        for rule, rows in rules.items()
    }


def _has_checkpoint(directory: Path) -> bool:
    return latest_iteration(directory / CHECKPOINTS) is not None


def _from_here(folder: str) -> str:
    path = Path(folder)
    return str(path.relative_to(Path.cwd())) if path.is_relative_to(Path.cwd()) else folder
