"""Execution of a session: stored runs, training, energy measurement, rule episodes, results table."""

import shlex
import sys
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from headway.adapters.env_file import is_file_id
from headway.config.experiment import ExperimentConfig
from headway.contracts.errors import HeadwayError
from headway.events import Row
from headway.rollout.workers.usage import usable_cores
from headway.stats.comparison import mean_return
from headway.store.session import SessionStore
from headway.wording import counted, environment_name
from headway_launch.console.output import ignore_closed_pipe, own_name, print_line, print_notice, relative
from headway_launch.experiments.parameters import session_settings
from headway_launch.experiments.rules import require_valid_actions
from headway_launch.runner.cell import Rules, SessionCell
from headway_launch.runner.cluster.ray_cluster import SessionCluster
from headway_launch.runner.comparison import Comparison, print_findings
from headway_launch.runner.jobs import CellPlan, PlannedJob, require_free_disk
from headway_launch.runner.recorder import JobRecorder
from headway_launch.runner.results import (
    SeedResult,
    last_evaluation,
    print_cells,
    print_seeds,
    run_summary,
)
from headway_launch.runner.scheduler import Scheduler
from headway_launch.runner.session_energy import SessionEnergy
from headway_launch.runner.session_job import SessionJob
from headway_launch.runner.training_process import Training
from headway_launch.runner.warm_up import compile_kernels_of

if TYPE_CHECKING:
    from headway.store.query import RunSelection

EXIT_DONE, EXIT_FAILED, EXIT_STOPPED = 0, 2, 130
_MAX_LISTED_RUNS = 3
_SHORTEST_MEASURED_S = 60.0
"""Minimum training time for which the store's share is printed, s; start-up and shutdown dominate shorter
ones."""


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
        self._rules_stopped = False
        planned = [job for cell in cells for job in cell.jobs]
        self._cluster = SessionCluster.open([job.config.backend for job in planned])
        try:
            self._shares = self._cluster.share_cores(self._config.backend, planned, usable_cores())
            require_free_disk(Path(self._config.store.root), planned, self._shares.parallel)
            compile_kernels_of([cell.experiment for cell in cells if cell.jobs])
            # Jobs with one prepared environment have the same rules.
            job_of_environment = {id(job.training.plan.prepared): job for job in planned}
            for job in job_of_environment.values():
                require_valid_actions(job.experiment, job.training.plan.prepared)
            kept = [job for cell in cells if not cell.temporary for job in cell.jobs]
            _print_training_notices([job for job in kept if not job.resumed])
            self._store = SessionStore(self._config.store)
            self._cells = [SessionCell(self._store, cell) for cell in cells]
            self._jobs = [SessionJob.of(cell, job) for cell in self._cells for job in cell.plan.jobs]
            self._energy = SessionEnergy(self._config.energy, self._jobs)
        except BaseException:
            self._cluster.close()
            raise

    def run(self, report: bool = True) -> int:
        """Train, evaluate the rules and print the results, if `report`; return the exit code."""
        began, self._own_cpu_s = time.monotonic(), -time.process_time()
        scheduler = Scheduler(self._jobs, self._shares, self._start, self._store_end, self._tick)
        try:
            stopped = scheduler.run()
            self._store_unstarted(stopped)
            self._add_results_of_others()
            rules_from = time.thread_time()
            self._rules_stopped = not stopped and not self._play_rules()
            stopped = stopped or self._rules_stopped
            self._own_cpu_s -= time.thread_time() - rules_from
        finally:
            self._end_cells()
            for line in (*self._energy.notices(), *self._store.close()):
                print_line(f"headway: {line}")
            self._cluster.close()
        self._own_cpu_s += time.process_time()
        if report:
            with ignore_closed_pipe(sys.stdout):
                self._print()
            self._print_summary(time.monotonic() - began)
        return self._exit_code(stopped)

    def selection(self) -> "RunSelection":
        """Return the runs that have ended, in this session or before it.

        Raises HeadwayError if a job failed before it created its runs.
        """
        from headway.store.query import select

        if missing := sum(len(job.planned.seeds) for job in self._jobs if job.has_no_runs):
            raise HeadwayError(f"{counted(missing, 'run')} could not be begun; the lines above say why")
        ended = [run_id for cell in self._cells for run_id in cell.results]
        return select(self._config.store.root, run_id=ended)

    def left_to_others(self) -> list[Path]:
        """Return the folders of runs that other sessions train, or trained without finishing them."""
        results = {result.directory for cell in self._cells for result in cell.results.values()}
        return [folder for _, folder in self._of_others() if folder not in results]

    def _of_others(self) -> list[tuple[SessionCell, Path]]:
        planned = [(cell, folder) for cell in self._cells for folder in cell.plan.elsewhere]
        return planned + [(job.cell, folder) for job in self._jobs for folder in job.elsewhere]

    def _add_results_of_others(self) -> None:
        for cell, folder in self._of_others():
            with suppress(HeadwayError):  # damaged
                result = SeedResult.read(folder)
                if result.status == "FINISHED":
                    cell.results[folder.name] = result

    def _start(self, job: SessionJob) -> Training:
        """Create or reopen the runs of a job and start its training process."""
        training = job.begin(self._shares)
        backend = self._cluster.backend(training.config.backend)
        return self._cluster.open_training(
            replace(training, config=replace(training.config, backend=backend))
        )

    def _store_end(self, job: SessionJob) -> None:
        """End the runs of a job in the store and add their results, which a restart of the job replaces."""
        recorder, cell = job.recorder, job.cell
        if recorder is None:  # failed before its runs were created
            return
        energy, mode = self._energy.finish(job), cell.config.evaluation.modes[0]
        for run, used in zip(recorder.runs, energy, strict=True):
            summary = run_summary(run, mode, used, self._energy.modes)
            run.finish(job.stored_status, summary)
            cell.results[run.run_id] = SeedResult.read(run.directory)
        if self._debug and recorder.failure:
            print_line(recorder.failure.traceback)

    def _tick(self) -> tuple[str, ...]:
        self._energy.sample_if_due()
        return (*self._store.notices(), *self._energy.notices())

    def _store_unstarted(self, stopped: bool) -> None:
        """Store the runs that never started as killed, so that `headway resume` finds them."""
        for job in self._jobs:
            if stopped and job.has_no_runs and not self._plan_kept:
                job.create_runs(self._shares)
                self._store_end(job)

    def _play_rules(self) -> bool:
        """Play the rules of all cells; return False if Ctrl-C or SIGTERM ended that."""
        played: dict[str, Rules] = {}
        try:
            for cell in self._cells:
                cell.play_rules(played)
        except KeyboardInterrupt:
            return False
        return True

    def _end_cells(self) -> None:
        metrics = self._energy.stop()
        for cell in self._cells:
            # Also cells without jobs: a killed session may have left them open in MLflow.
            jobs = [job for job in self._jobs if job.cell is cell]
            if jobs and all(job.elsewhere for job in jobs):
                continue  # other sessions train it
            statuses = [job.stored_status for job in jobs if not job.elsewhere]
            try:
                cell.finish(statuses, metrics if cell.touched else {})
            except HeadwayError as error:  # the runs are stored
                print_line(f"headway: {error}")

    def _exit_code(self, stopped: bool) -> int:
        if stopped:
            return EXIT_STOPPED
        failed = any(job.stored_status == "FAILED" for job in self._jobs)
        # Another session has part of a stack, so that the other seeds have no run.
        untrained = any(job.elsewhere and len(job.elsewhere) < len(job.planned.seeds) for job in self._jobs)
        return EXIT_FAILED if failed or untrained else EXIT_DONE

    def _print(self) -> None:
        if len(self._cells) == 1:
            [cell] = self._cells
            print_seeds(cell.config, cell.in_order())
        else:
            print_cells(
                self._config.study,
                [(cell.plan.label, len(cell.config.seed), cell.in_order()) for cell in self._cells],
                {cell.config.evaluation.episodes for cell in self._cells},
            )
        together: dict[tuple[object, ...], list[SessionCell]] = {}
        for cell in self._cells:
            evaluation = cell.config.evaluation
            key = cell.evaluation_key, evaluation.modes[0], evaluation.episodes
            together.setdefault(key, []).append(cell)
        for cells in together.values():
            self._print_comparison(cells)

    def _print_comparison(self, cells: Sequence[SessionCell]) -> None:
        """Print the last evaluations of cells beside the rules, which played the same episodes."""
        config, env = cells[0].config, cells[0].experiment.env
        learned: dict[str, list[list[Row]]] = {}
        rules: dict[str, list[Row]] = {}
        for cell in cells:
            name = cell.plan.label or cell.experiment.algo_name
            if name in learned:  # cells that differ in `evaluation` only have one label
                name += f" ({len(learned) + 1})"
            try:
                played = last_evaluation(cell.config.evaluation, cell.in_order())
            except HeadwayError as error:
                print_line(f"headway: {error}")
                continue
            if played:
                learned[name] = played
                rules |= cell.rules
        if not learned or not rules:
            return
        own, count = config.evaluation.episodes, config.evaluation.last_episodes
        kind = f"{environment_name(config.env.id)}, {config.evaluation.modes[0]}"
        title = f"last evaluation: {counted(count, 'episode')} of {kind}"
        best_first = sorted(learned.items(), key=lambda each: -mean_return(each[1]))
        comparison = Comparison.of(title, env.metrics, rules, dict(best_first))
        print()
        comparison.show()
        others = f" and {counted(count - own, 'other')}" if count > own else ""
        print_line(
            f"last evaluation: final policies and rules on the curve's {counted(own, 'episode')}{others}"
        )
        print_findings(comparison, learned, rules)

    def _print_summary(self, seconds: float) -> None:
        root, study = self._config.store.root, shlex.quote(self._config.study)
        results = [result for cell in self._cells for result in cell.results.values()]
        folders = sorted({result.directory.parent for result in results})
        where = ", ".join(relative(folder) for folder in folders)
        option = "" if root == type(self._config.store)().root else f" --store {shlex.quote(root)}"
        if where:
            print_line(
                f"{seconds:.0f} s; run folders in {where}; view them with: {own_name()} browse{option}"
            )
        if any(result.status == "FINISHED" for result in results):
            print_line(f"all metrics, curves and costs on one page: {own_name()} report {study}{option}")
        if left := self.left_to_others():
            print_line(f"headway: {counted(len(left), 'run')} left to other sessions, not in this table")
        recorders = [job.recorder for job in self._jobs if job.recorder is not None]
        if share := store_share(recorders, self._own_cpu_s):
            print_line(share)
        unfinished = [result.record.run_id for result in results if result.status in ("KILLED", "FAILED")]
        not_started = sum(
            len(job.planned.seeds) - len(job.elsewhere)
            for job in self._jobs
            if job.recorder is None and not job.lost_at
        )
        if unfinished or not_started:
            named = (
                " ".join(unfinished)
                if len(unfinished) <= _MAX_LISTED_RUNS and not self._plan_kept
                else f"--study {study}"
            )
            started = f"{counted(len(unfinished), 'run')} unfinished, " if unfinished else ""
            waiting = f"{started}{counted(not_started, 'run')} not started; " if not_started else ""
            failed = [
                cell.experiment.config.env.id
                for cell in self._cells
                if any(result.status == "FAILED" for result in cell.results.values())
            ]
            when = "to continue, once the cause of the failure is fixed" if failed else "to continue"
            if results and not failed and not any(result.record.durable_iteration for result in results):
                when = "nothing was kept: no checkpoint was written yet; to start again"
            if files := sorted({Path(env).name for env in failed if is_file_id(env)}):
                when = (
                    f"fix {' and '.join(files)}, then give the first command again (a changed file is not "
                    "resumed); if the cause lies elsewhere"
                )
            print_line(f"headway: {waiting}{when}: {own_name()} resume {named}{option}")
        elif self._rules_stopped:
            how = f"resume --study {study}" if self._plan_kept else f"compare {study}"
            print_line(
                f"headway: stopped before all rules were played; to play them: {own_name()} {how}{option}"
            )


def store_share(recorders: Sequence[JobRecorder], own_cpu_s: float) -> str:
    """Return the line on the store's share of the training time; empty after a short training.

    `own_cpu_s`: CPU seconds of the session's process.
    """
    trained, kept = (sum(getattr(each, name) for each in recorders) for name in ("trained_s", "store_s"))
    if trained < _SHORTEST_MEASURED_S:
        return ""
    summed = ", summed over jobs" if len(recorders) > 1 else ""
    return (
        f"storage took {(kept + own_cpu_s) / trained:.1%} of {trained:,.0f} s of training{summed} (logs and "
        f"checkpoints {kept:.1f} s, records and energy {own_cpu_s:.1f} CPU s)"
    )


def run_sessions(cells: Sequence[CellPlan], debug: bool, plan_kept: bool) -> tuple[int, list[Path]]:
    """Run cells in groups of equal session settings, one group after another.

    Returns the worst exit code and the folders of runs that are left to other sessions.
    """
    sessions: dict[str, list[CellPlan]] = {}
    for cell in cells:
        sessions.setdefault(str(session_settings(cell.experiment.config)), []).append(cell)
    worst, left = EXIT_DONE, list[Path]()
    for together in sessions.values():
        runner = Runner(together, debug, plan_kept)
        worst = max(worst, runner.run())
        left += runner.left_to_others()
        if worst == EXIT_STOPPED:
            break
    return worst, left


def _print_training_notices(new: Sequence[PlannedJob]) -> None:
    """Print what the training environments of new jobs have to say on their settings."""
    plans = [plan for job in new for plan in (job.training.plan, *job.training.later_plans)]
    for plan in plans:
        for line in getattr(plan.training_prepared, "training_notices", ()):
            print_notice(line)
