"""What a sweep would take: its runs listed, time and energy estimated from a short calibration."""

import tempfile
import time
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from heapq import heapify, heapreplace
from multiprocessing.connection import wait
from pathlib import Path
from typing import Any

from headway.config import ExperimentConfig
from headway.contracts.errors import HeadwayError
from headway.energy import EnergyMeter, JobUsage
from headway.events import EvaluationFinished, Event, Failed, IterationFinished, Started, Usage
from headway.store.provenance import usable_cores
from headway_launch.kernels import compile_kernels
from headway_launch.planning import CellPlan, PlannedJob, Shares, share_cores, uses_gpu, workers_of
from headway_launch.progress import duration
from headway_launch.study_plan import Standing
from headway_launch.tables import Cell, print_table
from headway_launch.telling import tell
from headway_launch.training_process import TrainingProcess

_ITERATIONS = 6
"""Measured of each cell, after a first that does not count: it holds what happens once."""
_SECONDS = 30.0
"""After so long two are enough."""
_PATIENCE_S = 600.0
_POLL_S = 0.2


@dataclass(frozen=True)
class Pace:
    """What parts of one job take, as measured; CPU seconds are of its training process and workers."""

    start_s: float
    """To the beginning of training."""
    evaluation_s: float
    """One evaluation that is not the last."""
    iteration_s: float
    cpu_start_s: float
    """To the first iteration, the first evaluation included."""
    cpu_iteration_s: float
    iterations: int
    """Measured."""
    kwh: float | None = None
    """Of a CPU second; None where energy is not measured."""
    kg_co2: float | None = None
    """Of a CPU second."""

    def of_job(self, config: ExperimentConfig, done: int) -> "Expectation":
        """What a job takes from iteration `done` on."""
        evaluations = evaluations_left(config, done)
        evaluating = evaluations * self.evaluation_s
        left = config.iterations - done
        rate = self.cpu_iteration_s / self.iteration_s
        cpu = self.cpu_start_s + left * self.cpu_iteration_s + evaluating * rate
        start = self.start_s + (0.0 if done else self.evaluation_s)
        return Expectation(start + evaluating + left * self.iteration_s, cpu, self.kwh, self.kg_co2)


@dataclass(frozen=True)
class Expectation:
    """What one job takes."""

    seconds: float
    cpu_s: float
    kwh_per_cpu_s: float | None
    kg_per_cpu_s: float | None

    @property
    def kwh(self) -> float | None:
        """None where energy is not measured."""
        return None if self.kwh_per_cpu_s is None else self.cpu_s * self.kwh_per_cpu_s

    @property
    def kg_co2(self) -> float | None:
        """None where energy is not measured."""
        return None if self.kg_per_cpu_s is None else self.cpu_s * self.kg_per_cpu_s


def print_estimate(standings: Sequence[Standing], cells: Sequence[CellPlan]) -> int:
    """List the runs of a sweep and estimate what those that are left take; returns the exit code. Nothing is
    written to the store.

    Raises HeadwayError if what is to be measured cannot run.
    """
    planned = [job for cell in cells for job in cell.jobs]
    config = cells[0].experiment.config
    shares = share_cores(config.backend, planned, usable_cores())
    paces, modes = _calibrate([cell for cell in cells if cell.jobs], shares) if planned else ({}, "")
    rows: list[tuple[Cell, ...]] = []
    expected: list[Expectation] = []
    for standing, cell in zip(standings, cells, strict=True):
        label = cell.label or cell.experiment.algo_name
        pace = paces.get(id(cell))
        for job in cell.jobs:
            assert pace is not None
            expectation = pace.of_job(cell.experiment.config, job.iteration)
            expected.append(expectation)
            what = (
                f"goes on at {job.iteration} of {cell.experiment.config.iterations}"
                if job.resumed
                else "begins"
            )
            figures = (expectation.seconds, expectation.cpu_s, expectation.kwh, expectation.kg_co2)
            share = (None if figure is None else figure / len(job.seeds) for figure in figures[1:])
            of_seed = (expectation.seconds, *share)
            rows += [(label, seed, what, *of_seed) for seed in job.seeds]
        rows += [(label, run.record.seed, "has finished", *(None,) * 4) for run in standing.finished]
        rows += [(label, run.record.seed, "runs elsewhere", *(None,) * 4) for run in standing.elsewhere]
    columns = ("cell", "seed", "what happens", "seconds", "CPU s", "kWh", "kg CO2eq")
    print_table(columns, rows, f"study {config.study}", spare=("kg CO2eq",))
    _print_totals(expected, shares.parallel, list(paces.values()), modes)
    return 0


def makespan(seconds: Sequence[float], parallel: int) -> float:
    """How long jobs take together, each begun in order when one of `parallel` places is free."""
    free = [0.0] * max(parallel, 1)
    heapify(free)
    for each in seconds:
        heapreplace(free, free[0] + each)
    return max(free)


def evaluations_left(config: ExperimentConfig, done: int) -> float:
    """Evaluations from iteration `done` to the end, the last counted as so many as it has episodes; the
    first, before training, belongs to the start."""
    a_step, every = config.rollout.copies * config.rollout.steps, config.evaluation.every
    reached = sum(
        iteration * a_step // every > (iteration - 1) * a_step // every
        for iteration in range(done + 1, config.iterations)
    )
    return reached + config.evaluation.last_episodes / config.evaluation.episodes


def _print_totals(expected: Sequence[Expectation], parallel: int, paces: Sequence[Pace], modes: str) -> None:
    if not expected:
        tell("headway: nothing is left to train")
        return
    wall = makespan([each.seconds for each in expected], parallel)
    known = [each.kwh for each in expected if each.kwh is not None]
    emitted = [each.kg_co2 for each in expected if each.kg_co2 is not None]
    energy = f", {sum(known):.3g} kWh, {sum(emitted):.3g} kg CO2eq" if known else ", energy not measured"
    cpu = sum(each.cpu_s for each in expected)
    print(
        f"\n{len(expected)} trainings, {parallel} at once: about {duration(wall)}, {cpu:,.0f} CPU s{energy}"
    )
    fewest = min(pace.iterations for pace in paces)
    cells = "the cell" if len(paces) == 1 else f"each of {len(paces)} cells"
    print(
        f"The estimate rests on {fewest} iterations or more and one evaluation of {cells},"
        f" measured just now with {parallel} processes at once; later iterations are taken to be as long and "
        "this machine to be as busy."
    )
    if known:
        print(f"Energy: what CodeCarbon gave a CPU second meanwhile; {modes}.")


@dataclass
class _Trial:
    """One training process that is measured."""

    process: TrainingProcess
    name: str
    launched: float
    uses_gpu: bool = False
    began: float = 0.0
    evaluated: float = 0.0
    cpu_start_s: float = 0.0
    marks: list[tuple[float, float]] = field(default_factory=list)
    """(seconds of the iteration, CPU seconds after it)."""
    usage: Usage = field(default_factory=Usage)
    process_ids: tuple[int, ...] = ()

    def take(self, event: Event) -> None:
        now = time.monotonic()
        match event:
            case Started(process_ids=process_ids):
                self.began, self.process_ids = now, process_ids
            case EvaluationFinished(usage=usage):
                if not self.marks:
                    self.evaluated, self.cpu_start_s = now, usage.cpu_seconds
                self.usage = usage
            case IterationFinished(usage=usage, curve=curve):
                seconds = float(curve[0]["time/collect_s"]) + float(curve[0]["time/learn_s"])
                self.marks.append((seconds, usage.cpu_seconds))
                self.usage = usage
            case Failed(line=line):
                raise HeadwayError(f"the calibration of {self.name} failed: {line}")

    def is_enough(self, iterations: int) -> bool:
        measured = len(self.marks) - 1
        late = self.evaluated and time.monotonic() - self.evaluated > _SECONDS
        return measured >= min(_ITERATIONS, iterations - 1) or (measured >= 2 and bool(late))

    def pace(self, kwh: float | None, kg_co2: float | None) -> Pace:
        counted = self.marks[1:] or self.marks
        first = self.marks[0][1] if len(self.marks) > 1 else self.cpu_start_s
        return Pace(
            start_s=self.began - self.launched,
            evaluation_s=self.evaluated - self.began,
            iteration_s=max(sum(seconds for seconds, _ in counted) / len(counted), 1e-9),
            cpu_start_s=self.cpu_start_s,
            cpu_iteration_s=(self.marks[-1][1] - first) / len(counted),
            iterations=len(counted),
            kwh=kwh,
            kg_co2=kg_co2,
        )


def _calibrate(cells: Sequence[CellPlan], shares: Shares) -> tuple[dict[int, Pace], str]:
    """The pace of each cell, by its `id`, and how its power is known. As many processes run at once as
    later will: the first cells again, where there are fewer."""
    for env in {id(cell.experiment.env): cell.experiment.env for cell in cells}.values():
        compile_kernels(env)
    tell(f"headway: measuring, cells: {len(cells)}, processes at once: {shares.parallel}; nothing is kept")
    missing = max(shares.parallel - len(cells), 0)
    waiting = deque([*cells, *(cells[place % len(cells)] for place in range(missing))])
    paces: dict[int, Pace] = {}
    meter = EnergyMeter.start(cells[0].experiment.config.energy)
    meter.wait()
    running: dict[str, tuple[CellPlan, _Trial]] = {}
    with tempfile.TemporaryDirectory(prefix="headway-") as folder:
        try:
            while waiting or running:
                while waiting and len(running) < shares.parallel:
                    cell = waiting.popleft()
                    name = str(len(waiting))
                    running[name] = (cell, _trial(cell, shares, Path(folder, name)))
                _hear(running)
                for name, (cell, trial) in list(running.items()):
                    if trial.is_enough(cell.experiment.config.iterations):
                        trial.process.kill()
                        trial.process.join()
                        del running[name]
                        usages = {other: _usage(found) for other, (_, found) in running.items()}
                        energy = meter.finish(name, usages, _usage(trial))
                        spent = max(energy.cpu_seconds, 1e-9)
                        kwh = None if energy.kwh is None else energy.kwh / spent
                        kg = None if energy.kg_co2 is None else energy.kg_co2 / spent
                        paces.setdefault(id(cell), trial.pace(kwh, kg))
        finally:
            for _, trial in running.values():
                trial.process.kill()
                trial.process.join()
            meter.stop()
    modes = ", ".join(
        f"{part.removeprefix('energy.')} {mode}" for part, mode in meter.modes.as_tags().items()
    )
    return paces, modes


def _hear(running: dict[str, tuple[CellPlan, _Trial]]) -> None:
    by_handle: dict[Any, _Trial] = {trial.process.connection: trial for _, trial in running.values()}
    for handle in wait(list(by_handle), _POLL_S):
        trial = by_handle[handle]
        while trial.process.has_event():
            event = trial.process.receive()
            if event is None and trial.marks:  # so few iterations that all have been done
                break
            if event is None:
                raise HeadwayError(f"the calibration of {trial.name} failed: {trial.process.join()}")
            trial.take(event)
    for _, trial in running.values():
        if time.monotonic() - trial.launched > _PATIENCE_S:
            raise HeadwayError(
                f"the calibration of {trial.name} takes longer than {_PATIENCE_S:g} s: give it up"
            )


def _trial(cell: CellPlan, shares: Shares, folder: Path) -> _Trial:
    job: PlannedJob = cell.jobs[0]
    never = replace(job.config.store, checkpoint_every=job.config.iterations)
    directories = [folder / str(seed) for seed in job.seeds]
    for directory in directories:
        directory.mkdir(parents=True)
    config = replace(job.config, store=never)
    training = job.training_job(config, workers_of(job, shares), directories)
    launched = time.monotonic()
    name = cell.label or job.experiment.algo_name
    return _Trial(TrainingProcess(training), name, launched, uses_gpu(job))


def _usage(trial: _Trial) -> JobUsage:
    used = trial.usage
    return JobUsage(used.cpu_seconds, used.memory_bytes, trial.uses_gpu, trial.process_ids)
