"""A dry run: the runs of a session, and their time and energy as finished runs or a calibration predict."""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from heapq import heapify, heapreplace
from itertools import pairwise
from pathlib import Path
from statistics import fmean

from headway.config.experiment import ExperimentConfig
from headway.contracts.errors import HeadwayError
from headway.rollout.workers.usage import usable_cores
from headway.store.index import RunIndex
from headway.store.run_folder import Process, read_summary
from headway.wording import counted, environment_name, spans
from headway_launch.console.output import print_line
from headway_launch.console.progress import duration
from headway_launch.console.tables import Value, print_table, without_empty
from headway_launch.experiments.parameters import full_mapping, pace_key
from headway_launch.runner.calibration import Expectation, Pace, calibrate
from headway_launch.runner.cores import share_cores
from headway_launch.runner.jobs import CellPlan
from headway_launch.runner.stored_run import StoredRun
from headway_launch.studies.plan import StudyProgress, plan_cells
from headway_launch.studies.search_session import SearchSession

_MOST_READ = 50
"""Most finished runs of an algorithm, from the newest on, that are searched for a known pace."""


def print_estimate(progress: Sequence[StudyProgress], cells: Sequence[CellPlan]) -> int:
    """Print the runs of a session and the estimated cost of training them; return the exit code.

    A cell with finished runs on this machine costs as much as their mean, and a cell with none as much per
    iteration as finished runs with its `pace_key`. The other cells are measured, by training them for a few
    iterations. Nothing is written to the store.

    Raises HeadwayError if a cell cannot be trained.
    """
    planned = [job for cell in cells for job in cell.jobs]
    config = cells[0].experiment.config
    named = [cell.label or cell.experiment.algo_name for cell in cells]
    kinds = [
        (name, _iteration(cell), *kind)
        for name, each, cell in zip(named, progress, cells, strict=True)
        for kind in _seeds_by_action(each, cell)
    ]
    print_table(("cell", "iteration", "seeds", "runs", "action"), kinds, f"study {config.study}")
    if not planned:
        print_line("headway: nothing is left to train")
        return 0
    print(flush=True)  # show the list during the calibration
    shares = share_cores(config.backend, planned, usable_cores())
    stored = [_as_finished_runs(each.finished, cell) for each, cell in zip(progress, cells, strict=True)]
    finished = sum(map(bool, stored))
    stored = [
        known or _as_finished_runs(_alike(cell), cell) for known, cell in zip(stored, cells, strict=True)
    ]
    alike = sum(map(bool, stored)) - finished
    unknown = [cell for cell, known in zip(cells, stored, strict=True) if cell.jobs and not known]
    paces, modes = calibrate(unknown, shares) if unknown else ({}, "")
    rows: list[tuple[Value, ...]] = []
    known_from: dict[str, int] = {}
    expected: list[Expectation] = []
    for name, cell, known in zip(named, cells, stored, strict=True):
        if cell.jobs:
            config = cell.experiment.config
            estimates = known or [paces[id(cell)].estimate(config, job.iteration) for job in cell.jobs]
            rows.append(
                (
                    name,
                    len(estimates),
                    sum(job.seconds for job in estimates) / len(estimates),
                    *_totals(estimates),
                )
            )
            expected += estimates
    columns = ("cell", "jobs", "s per job", "total CPU s", "total kWh", "total kg CO2eq")
    kept, kept_rows = without_empty(columns, rows, columns[-1:])
    print_table(kept, kept_rows, spare=kept[:3:-1])
    if finished:
        known_from["as the mean of finished runs"] = finished
    if alike:
        known_from["at the pace of finished runs with the same environment, rollout and algorithm"] = alike
    _print_totals(expected, shares.parallel, list(paces.values()), modes, config.backend.name, known_from)
    runs = sum(len(job.seeds) for job in planned)
    if runs != len(planned):
        most = max(len(job.seeds) for job in planned)
        print(
            f"{counted(runs, 'run')} in {counted(len(planned), 'job')}: a job trains up to {most} seeds at "
            "once (backend.stack)."
        )
    return 0


def print_search_estimate(session: SearchSession, ended: Mapping[str, int]) -> int:
    """Print the budget of a search and the estimated cost of training what is left; return the exit code.

    The first candidate of each algorithm is measured, by training it for a few iterations. `ended`: number of
    candidates per algorithm that have ended. Nothing is written to the store.

    Raises HeadwayError if a candidate cannot be trained.
    """
    search = session.search
    rungs = ", ".join(
        f"{count} to {end:,}"
        for count, end in zip(search.left_at(search.batch or search.candidates), search.ends, strict=True)
    )
    rows = [
        (
            part.label,
            part.candidates,
            ended[part.label],
            search.seeds,
            rungs,
            part.steps(),
            ", ".join(part.space),
        )
        for part in session.parts
    ]
    columns = ("algorithm", "candidates", "ended", "seeds", "of a batch, to step", "steps in all", "searched")
    print_table(columns, rows, f"study {session.config.study}")
    if all(ended[part.label] == part.candidates for part in session.parts):
        print_line("headway: nothing is left to train")
        return 0
    print(end="", flush=True)  # show the list during the calibration
    first = [each for each in session.drawn(0) if each.trial.number == 0]
    progress = [StudyProgress.untouched(candidate.experiment) for candidate in first]
    cells = plan_cells(progress, [candidate.part.label for candidate in first])
    jobs = [job for cell in cells for job in cell.jobs]
    together = max(len(part.batches[0]) for part in session.parts)
    shares = share_cores(session.config.backend, jobs * together, usable_cores())
    paces, modes = calibrate(cells, shares)
    expected: list[Expectation] = []
    for candidate, cell in zip(first, cells, strict=True):
        part, config = candidate.part, candidate.experiment.config
        ends = [0, *map(candidate.iteration_at, search.ends)]
        costs = [_until(paces[id(cell)], config, *span) for span in pairwise(ends)]
        for batch in part.batches:
            if batch.stop > ended[part.label]:
                for cost, count in zip(costs, search.left_at(len(batch)), strict=True):
                    expected += [cost] * count * len(cell.jobs)
    _print_totals(expected, shares.parallel, list(paces.values()), modes, config.backend.name, {})
    return 0


def _until(pace: Pace, config: ExperimentConfig, begin: int, end: int) -> Expectation:
    """Return the expected cost of a job from iteration `begin` to `end`, where it pauses."""
    whole, rest = pace.estimate(config, begin), pace.estimate(config, end)
    if end >= config.iterations:
        return whole
    cpu_s = whole.cpu_s - rest.cpu_s + pace.cpu_start_s
    energy = (None if each is None else cpu_s * each for each in (pace.kwh, pace.kg_co2))
    return Expectation(whole.seconds - rest.seconds + pace.start_s, cpu_s, *energy)


def _alike(cell: CellPlan) -> list[StoredRun]:
    """Return the newest finished runs of the store that have the cell's `pace_key`, of any study."""
    config, found = cell.experiment.config, []
    wanted, environment = pace_key(full_mapping(cell.experiment, ())), environment_name(config.env.id)
    rows = [
        row
        for row in RunIndex(Path(config.store.root)).rows()
        if row.status == "FINISHED" and row.algorithm == cell.experiment.algo_name
    ]
    for row in rows[: -_MOST_READ - 1 : -1]:
        if environment_name(row.environment) == environment:
            with suppress(HeadwayError):  # a damaged run
                run = StoredRun.read(Path(config.store.root), Path(row.directory))
                found += [run] if pace_key(run.mapping) == wanted else []
    return found


def _as_finished_runs(finished: Sequence[StoredRun], cell: CellPlan) -> list[Expectation]:
    """Return the expected cost of each job of a cell: the mean of finished runs, each stretched to the number
    of iterations of the cell.

    Empty if there are none that were trained on this machine, as many seeds at once.
    """
    host, stacks = Process.current().host, {len(job.seeds) for job in cell.jobs}
    runs = [run for run in finished if run.record.session.host == host and {len(run.plan.stack)} == stacks]
    if not runs:
        return []
    stretches = [cell.experiment.config.env_steps / run.mapping["env_steps"] for run in runs]
    summaries = [read_summary(run.directory) for run in runs]

    def mean(name: str) -> float | None:
        values = [
            float(value) * stretch
            for summary, stretch in zip(summaries, stretches, strict=True)
            if (value := summary.get(name)) is not None
        ]
        return sum(values) / len(values) if values else None

    seconds = fmean(run.record.duration_s * stretch for run, stretch in zip(runs, stretches, strict=True))
    cpu_s, energy = mean("cpu_seconds") or 0.0, (mean("kwh"), mean("kg_co2"))
    expected = []
    for job in cell.jobs:
        share = 1 - job.iteration / cell.experiment.config.iterations
        seeds = len(job.seeds) * share
        used = (None if each is None else seeds * each for each in energy)
        expected.append(Expectation(seconds * share, seeds * cpu_s, *used))
    return expected


def makespan(seconds: Sequence[float], parallel: int) -> float:
    """Return the seconds until all jobs have ended if they start in order, `parallel` at a time."""
    free = [0.0] * max(parallel, 1)
    heapify(free)
    for each in seconds:
        heapreplace(free, free[0] + each)
    return max(free)


def _iteration(cell: CellPlan) -> str:
    rollout = cell.experiment.config.rollout
    return f"{rollout.copies} x {rollout.steps} steps"


def _seeds_by_action(progress: StudyProgress, cell: CellPlan) -> list[tuple[str, int, str]]:
    """Return (seeds as text, number of seeds, action) for each action that the session takes on a cell."""
    kinds: dict[str, list[int]] = {}
    for job in cell.jobs:
        iterations = cell.experiment.config.iterations
        action = f"resume at iteration {job.iteration} of {iterations}" if job.resumed else "train"
        kinds.setdefault(action, []).extend(job.seeds)
    others = {"none (finished)": progress.finished, "none (in another session)": progress.elsewhere}
    kinds |= {action: [run.record.seed for run in runs] for action, runs in others.items() if runs}
    return [(spans(seeds), len(seeds), action) for action, seeds in kinds.items()]


def _totals(expected: Sequence[Expectation]) -> tuple[float, float | None, float | None]:
    """Return the total CPU s, kWh and kg CO2eq of trainings; None for energy that is not measured."""
    known = [each.kwh for each in expected if each.kwh is not None]
    emitted = [each.kg_co2 for each in expected if each.kg_co2 is not None]
    cpu_s = sum(each.cpu_s for each in expected)
    return cpu_s, sum(known) if known else None, sum(emitted) if emitted else None


def _print_totals(
    expected: Sequence[Expectation],
    parallel: int,
    paces: Sequence[Pace],
    modes: str,
    backend: str,
    known_from: Mapping[str, int],
) -> None:
    """Print the sums. `known_from`: the number of cells known from each kind of stored runs."""
    wall = makespan([each.seconds for each in expected], parallel)
    cpu_s, kwh, kg = _totals(expected)
    energy = ", energy not measured" if kwh is None else f", {kwh:.3g} kWh"
    energy += "" if kg is None else f", {kg:.3g} kg CO2eq"
    print(
        f"\n{counted(len(expected), 'job')}, {parallel} in parallel: about {duration(wall)}, "
        f"{cpu_s:,.0f} CPU s{energy}"
    )
    for kind, number in known_from.items():
        print(f"Estimated {kind} on this machine: {counted(number, 'cell')}.")
    if not paces:
        return
    fewest = min(len(pace.counted) for pace in paces)
    cells = "the cell" if len(paces) == 1 else f"each of {len(paces)} cells"
    print(
        f"The estimate is from at least {fewest} iterations and one evaluation of {cells}, measured with "
        f"{counted(parallel, 'training')} in parallel; it assumes that later iterations take as long and "
        "this machine stays as busy."
    )
    if backend == "ray":
        print(
            "It was measured on this machine; on a cluster with other processors, or more of them, the times "
            "differ."
        )
    if kwh is not None:
        print(f"Energy: CodeCarbon's value per CPU second during the calibration; {modes}.")
