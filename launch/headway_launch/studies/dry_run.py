"""A dry run: the runs of a session, and their time and energy as finished runs or a calibration predict."""

from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from statistics import fmean

from headway.config.experiment import ExperimentConfig
from headway.rollout.workers.usage import usable_cores
from headway.store.run_folder import Process, RunRecord, read_summary
from headway.wording import counted, spans
from headway_launch.console.output import print_line
from headway_launch.console.progress import duration, makespan
from headway_launch.console.tables import Value, print_table, without_empty
from headway_launch.runner.calibration import Expectation, Pace, calibrate
from headway_launch.runner.cores import share_cores
from headway_launch.runner.jobs import CellPlan
from headway_launch.runner.stored_run import StoredRun
from headway_launch.studies.plan import StudyProgress, plan_cells
from headway_launch.studies.search_session import SearchSession


def print_estimate(cells: Sequence[CellPlan]) -> int:
    """Print the runs of a session and the estimated cost of training them; return the exit code.

    A cell with finished runs on this machine costs as much as their mean. The other cells are measured, by
    training them for a few iterations. Nothing is written to the store.

    Raises HeadwayError if a cell cannot be trained.
    """
    planned = [job for cell in cells for job in cell.jobs]
    session = cells[0].experiment.config
    named = [cell.label or cell.experiment.algo_name for cell in cells]
    kinds = [
        (name, _iteration(cell), *kind)
        for name, cell in zip(named, cells, strict=True)
        for kind in _seeds_by_action(cell)
    ]
    print_table(("cell", "iteration", "seeds", "runs", "action"), kinds, f"study {session.study}")
    if not planned:
        print_line("headway: nothing is left to train")
        return 0
    print(flush=True)  # show the list during the calibration
    shares = share_cores(session.backend, planned, usable_cores())
    stored = list(map(_of_finished_runs, cells))
    measured = [cell for cell, known in zip(cells, stored, strict=True) if cell.jobs and not known]
    paces, modes = calibrate(measured, shares) if measured else ({}, "")
    rows: list[tuple[Value, ...]] = []
    expected: list[Expectation] = []
    for name, cell, known in zip(named, cells, stored, strict=True):
        if cell.jobs:
            config = cell.experiment.config
            estimates = known or [paces[id(cell)].estimate(config, job.iteration) for job in cell.jobs]
            mean_s = fmean(job.seconds for job in estimates)
            rows.append((name, len(estimates), mean_s, *_totals(estimates)))
            expected += estimates
    columns = ("cell", "jobs", "s per job", "total CPU s", "total kWh", "total kg CO2eq")
    kept, kept_rows = without_empty(columns, rows, columns[-1:])
    print_table(kept, kept_rows, spare=kept[:3:-1])
    _print_totals(expected, shares.parallel)
    if known_cells := sum(map(bool, stored)):
        print(f"Estimated as the mean of finished runs on this machine: {counted(known_cells, 'cell')}.")
    if paces:
        on_cluster = any(cell.experiment.config.backend.name == "ray" for cell in measured)
        _print_measurement(list(paces.values()), shares.parallel, modes, on_cluster)
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
    _print_totals(expected, shares.parallel)
    _print_measurement(list(paces.values()), shares.parallel, modes, session.config.backend.name == "ray")
    return 0


def _until(pace: Pace, config: ExperimentConfig, begin: int, end: int) -> Expectation:
    """Return the expected cost of a job from iteration `begin` to `end`, where it pauses."""
    whole, rest = pace.estimate(config, begin), pace.estimate(config, end)
    if end >= config.iterations:
        return whole
    cpu_s = whole.cpu_s - rest.cpu_s + pace.cpu_start_s
    energy = (None if each is None else cpu_s * each for each in (pace.kwh, pace.kg_co2))
    return Expectation(whole.seconds - rest.seconds + pace.start_s, cpu_s, *energy)


def _of_finished_runs(cell: CellPlan) -> list[Expectation]:
    """Return the expected cost of each job of a cell: the mean of its finished runs on this machine.

    Of runs of several stacks, those of the smallest are taken that has as many seeds as the cell's largest
    job. Empty if there are none.
    """
    host, most = Process.current().host, max((len(job.seeds) for job in cell.jobs), default=0)
    root = Path(cell.experiment.config.store.root)
    finished = [StoredRun.read(root, folder) for folder in cell.finished]
    here = [run for run in finished if run.record.session.host == host and len(run.plan.stack) >= most]
    runs = [run for run in here if len(run.plan.stack) == min(len(each.plan.stack) for each in here)]
    if not runs:
        return []
    summaries = [read_summary(run.directory) for run in runs]

    def mean(name: str) -> float | None:
        values = [float(value) for summary in summaries if (value := summary.get(name)) is not None]
        return fmean(values) if values else None

    seconds = fmean(run.record.duration_s for run in runs)
    cpu_s, energy = mean("cpu_seconds") or 0.0, (mean("kwh"), mean("kg_co2"))
    expected = []
    for job in cell.jobs:
        share = 1 - job.iteration / cell.experiment.config.iterations
        seeds = len(job.seeds) * share
        used = (None if each is None else seeds * each for each in energy)
        expected.append(Expectation(seconds * share, seeds * cpu_s, *used))
    return expected


def _iteration(cell: CellPlan) -> str:
    rollout = cell.experiment.config.rollout
    return f"{rollout.copies} x {rollout.steps} steps"


def _seeds_by_action(cell: CellPlan) -> list[tuple[str, int, str]]:
    """Return (seeds as text, number of seeds, action) for each action that the session takes on a cell."""
    kinds: dict[str, list[int]] = {}
    for job in cell.jobs:
        iterations = cell.experiment.config.iterations
        action = f"resume at iteration {job.iteration} of {iterations}" if job.resumed else "train"
        kinds.setdefault(action, []).extend(job.seeds)
    others = {"none (finished)": cell.finished, "none (in another session)": cell.elsewhere}
    kinds |= {action: [RunRecord.read(run).seed for run in runs] for action, runs in others.items() if runs}
    return [(spans(seeds), len(seeds), action) for action, seeds in kinds.items()]


def _totals(expected: Sequence[Expectation]) -> tuple[float, float | None, float | None]:
    """Return the total CPU s, kWh and kg CO2eq of trainings; None for energy that is not known of all."""
    cpu_s = sum(each.cpu_s for each in expected)
    return cpu_s, _whole([each.kwh for each in expected]), _whole([each.kg_co2 for each in expected])


def _whole(parts: Sequence[float | None]) -> float | None:
    """Return the sum of the parts; None if a part is missing."""
    known = [part for part in parts if part is not None]
    return sum(known) if len(known) == len(parts) else None


def _print_totals(expected: Sequence[Expectation], parallel: int) -> None:
    wall = makespan([each.seconds for each in expected], parallel)
    cpu_s, kwh, kg = _totals(expected)
    measured = sum(each.kwh is not None for each in expected)
    if kwh is not None:
        energy = f"{kwh:.3g} kWh" + ("" if kg is None else f", {kg:.3g} kg CO2eq")
    else:
        energy = f"energy known for {counted(measured, 'job')} only" if measured else "energy not measured"
    print(
        f"\n{counted(len(expected), 'job')}, {parallel} in parallel: about {duration(wall)}, "
        f"{cpu_s:,.0f} CPU s, {energy}"
    )


def _print_measurement(paces: Sequence[Pace], parallel: int, modes: str, on_cluster: bool) -> None:
    """Print the extent of the calibration. `on_cluster`: a measured cell will train with backend=ray."""
    fewest = min(len(pace.counted) for pace in paces)
    print(
        f"Estimated from an evaluation and at least {counted(fewest, 'iteration')}, measured with "
        f"{counted(parallel, 'training')} in parallel: {counted(len(paces), 'cell')}. This assumes that "
        "later iterations take as long and this machine stays as busy."
    )
    if on_cluster:
        print(
            "It was measured on this machine; on a cluster with other processors, or more of them, the times "
            "differ."
        )
    if any(pace.kwh is not None for pace in paces):
        print(f"Measured energy: CodeCarbon's value per CPU second during the calibration; {modes}.")
