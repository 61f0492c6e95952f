"""A short calibration: train each cell for a few iterations and keep only the measured durations and energy.

As many processes run at once as in the real session.
"""

import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from math import inf
from multiprocessing.connection import Connection, wait
from pathlib import Path
from statistics import fmean
from typing import TYPE_CHECKING

from headway.config.experiment import ExperimentConfig
from headway.contracts.errors import HeadwayError
from headway.energy.ledger import JobUsage
from headway.energy.meter import EnergyMeter
from headway.events import EvaluationFinished, Event, Failed, Finished, IterationFinished, Started, Usage
from headway.wording import counted
from headway_launch.console.progress_display import CountedProgress
from headway_launch.runner.cores import CoreShares, uses_gpu, workers_of
from headway_launch.runner.jobs import CellPlan, PlannedJob
from headway_launch.runner.training_process import TrainingProcess
from headway_launch.runner.warm_up import compile_kernels_of

if TYPE_CHECKING:
    from headway.training.loop import TrainingJob

_ITERATIONS = 6
"""Iterations measured per cell, after a first one that is not counted because it includes one-off work."""
_FEWEST, _SECONDS = 2, 3.0
"""Measurement also ends after `_SECONDS` of iterations if at least `_FEWEST` were measured."""
_PATIENCE_S = 600.0
_POLL_S = 0.2
_GRACE_S = 1.0
"""Seconds that a process may take to end after its last event."""


@dataclass(frozen=True)
class Expectation:
    """Expected cost of one job; None for energy and emissions that are not measured."""

    seconds: float
    cpu_s: float
    kwh: float | None
    kg_co2: float | None


@dataclass
class Pace:
    """The measurement of one cell, recorded in the session's process.

    CPU seconds are those of its training process and workers.
    """

    launched: float
    uses_gpu: bool = False
    start_s: float = 0.0
    """Seconds from launch to the beginning of training."""
    evaluation_s: float = 0.0
    """Seconds of one evaluation with the usual number of episodes; the last one may have more."""
    cpu_start_s: float = 0.0
    """CPU seconds until the end of the first evaluation."""
    marks: list[tuple[float, float]] = field(default_factory=list)
    """(seconds, CPU seconds) per iteration, without the evaluation that may precede it."""
    used: Usage = field(default_factory=Usage)
    process_ids: tuple[int, ...] = ()
    kwh: float | None = None
    """kWh per CPU second; None if energy is not measured."""
    kg_co2: float | None = None
    """kg CO2eq per CPU second; None if energy is not measured."""

    def take(self, event: Event) -> None:
        now = time.monotonic()
        match event:
            case Started(process_ids=process_ids):
                self.start_s, self.process_ids = now - self.launched, process_ids
            case EvaluationFinished(usage=usage):
                if not self.marks:
                    self.evaluation_s = now - self.launched - self.start_s
                    self.cpu_start_s = usage.cpu_seconds
                self.used = usage
            case IterationFinished(usage=usage, collect_s=collect_s, learn_s=learn_s):
                self.marks.append((collect_s + learn_s, usage.cpu_seconds - self.used.cpu_seconds))
                self.used = usage

    @property
    def usage(self) -> JobUsage:
        """Resources used so far."""
        return JobUsage(self.used.cpu_seconds, self.used.memory_bytes, self.uses_gpu, self.process_ids)

    @property
    def counted(self) -> list[tuple[float, float]]:
        """`marks` without that of the first iteration, if there are others."""
        return self.marks[1:] or self.marks

    @property
    def is_enough(self) -> bool:
        """Whether enough iterations have been measured."""
        measured = self.marks[1:]
        late = sum(seconds for seconds, _ in measured) > _SECONDS
        return len(measured) >= (_FEWEST if late else _ITERATIONS)

    @property
    def iteration_s(self) -> float:
        """Mean seconds of an iteration."""
        return max(fmean(seconds for seconds, _ in self.counted), 1e-9)

    @property
    def cpu_iteration_s(self) -> float:
        """Mean CPU seconds of an iteration."""
        return fmean(cpu for _, cpu in self.counted)

    def estimate(self, config: ExperimentConfig, done: int) -> Expectation:
        """Return the expected cost of a job that resumes after iteration `done`; 0 for a new job."""
        evaluating = evaluations_left(config, done) * self.evaluation_s
        left = config.iterations - done
        rate = self.cpu_iteration_s / self.iteration_s
        cpu = self.cpu_start_s + left * self.cpu_iteration_s + evaluating * rate
        start = self.start_s + (0.0 if done else self.evaluation_s)
        energy = (None if each is None else cpu * each for each in (self.kwh, self.kg_co2))
        return Expectation(start + evaluating + left * self.iteration_s, cpu, *energy)


def evaluations_left(config: ExperimentConfig, done: int) -> float:
    """Return the number of evaluations after iteration `done`, without the one before training.

    The last one is weighted by its episodes relative to the others. The evaluation before training is part of
    the start-up.
    """
    before_last = config.iterations - 1
    reached = config.evaluations_until(before_last) - config.evaluations_until(min(done, before_last))
    return reached + config.evaluation.last_episodes / config.evaluation.episodes


def calibrate(cells: Sequence[CellPlan], shares: CoreShares) -> tuple[dict[int, Pace], str]:
    """Return the pace of each cell, by its `id()`, and a description of the sources of power readings.

    If the cells do not fill the last round of processes, the first ones are trained again to keep the load
    realistic. Raises HeadwayError if a cell cannot be trained.
    """
    compile_kernels_of([cell.experiment for cell in cells])
    rounds = -(-len(cells) // shares.parallel)
    waiting = [cells[place % len(cells)] for place in range(rounds * shares.parallel)]
    paces: dict[int, Pace] = {}
    running: list[_Measurement] = []
    noted: set[int] = set()
    meter = EnergyMeter.start(cells[0].experiment.config.energy)
    meter.wait()
    with (
        tempfile.TemporaryDirectory(prefix="headway-") as folder,
        CountedProgress("cells measured", len(cells)) as progress,
    ):
        try:
            while waiting or running:
                while waiting and len(running) < shares.parallel:
                    place = Path(folder, str(len(waiting)))
                    started = _Measurement(waiting.pop(0), shares, place, progress)
                    running.append(started)
                    if id(started.cell) not in noted:
                        noted.add(id(started.cell))
                        progress.note(started.description)
                wait([each.waitable for each in running], _POLL_S)
                for ended in [each for each in running if each.receive_events()]:
                    running.remove(ended)
                    ended.process.kill()
                    ended.process.join()
                    pace, cell = ended.pace, ended.cell
                    others = {other.place: other.pace.usage for other in running}
                    energy = meter.finish(ended.place, others, pace.usage)
                    if id(cell) not in paces:
                        spent = max(energy.cpu_seconds, 1e-9)
                        pace.kwh = None if energy.kwh is None else energy.kwh / spent
                        pace.kg_co2 = None if energy.kg_co2 is None else energy.kg_co2 / spent
                        paces[id(cell)] = pace
                        progress.add()
        finally:
            for each in running:
                each.process.kill()
                each.process.join()
            meter.stop()
    modes = ", ".join(
        f"{part.removeprefix('energy.')} {mode}" for part, mode in meter.modes.as_tags().items()
    )
    return paces, modes


class _Measurement:
    """A training process that ends once enough of its cell has been measured."""

    def __init__(self, cell: CellPlan, shares: CoreShares, folder: Path, progress: CountedProgress) -> None:
        self.cell, self.name, self._progress = cell, cell.label or cell.experiment.algo_name, progress
        self.place, self._finished_at = str(folder), inf
        self.pace = Pace(time.monotonic(), uses_gpu(cell.jobs[0]))
        self.process = TrainingProcess(_training_job(cell.jobs[0], shares, folder))

    @property
    def waitable(self) -> Connection | int:
        """Object that is ready when an event has arrived or, after the last one, the process has ended."""
        return self.process.connection if self._finished_at == inf else self.process.sentinel

    @property
    def description(self) -> str:
        """What is measured, for the user."""
        config = self.cell.jobs[0].config
        most = counted(min(1 + _ITERATIONS, config.iterations), "iteration")
        return (
            f"measuring {self.name} for the estimate: start, an evaluation of "
            f"{counted(config.evaluation.episodes, 'episode')}, up to {most} of "
            f"{config.rollout.copies} x {config.rollout.steps} steps"
        )

    def receive_events(self) -> bool:
        """Process the events that have arrived; return whether the process has ended, or should be killed.

        Never waits, since the other processes' events are timed when they are received.

        Raises HeadwayError if training fails or takes too long.
        """
        while self._finished_at == inf and self.process.has_event():
            event = self.process.receive()
            match event:
                case Finished():
                    self._finished_at = time.monotonic()
                    break
                case Failed(line=line):
                    raise HeadwayError(f"the calibration of {self.name} failed: {line}")
                case None:
                    raise HeadwayError(f"the calibration of {self.name} failed: {self.process.join()}")
            self.pace.take(event)
            self._progress.add(0, f"{self.name}: iterations {len(self.pace.marks)}")
            if self.pace.is_enough:
                self.process.ask_to_stop()
        if self._finished_at < inf:
            return bool(wait([self.waitable], 0)) or time.monotonic() > self._finished_at + _GRACE_S
        if time.monotonic() - self.pace.launched > _PATIENCE_S:
            raise HeadwayError(
                f"the calibration of {self.name} takes longer than {_PATIENCE_S:g} s and is stopped; "
                "train without a dry run"
            )
        return False


def _training_job(job: PlannedJob, shares: CoreShares, folder: Path) -> "TrainingJob":
    # Checkpoints would be measured as part of the iterations.
    store = replace(job.config.store, checkpoint_every=job.config.iterations)
    directories = [folder / str(seed) for seed in job.seeds]
    for directory in directories:
        directory.mkdir(parents=True)
    return replace(
        job.training,
        config=replace(job.config, store=store),
        workers=workers_of(job, shares),
        directories=tuple(map(str, directories)),
    )
