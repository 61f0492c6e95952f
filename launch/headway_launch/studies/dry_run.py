"""What a session would take: its runs listed, time and energy estimated from a short calibration."""

from collections.abc import Sequence
from heapq import heapify, heapreplace

from headway.rollout.workers.usage import usable_cores
from headway.stats.plots import counted
from headway_launch.console.output import print_line
from headway_launch.console.progress import duration
from headway_launch.console.tables import Cell, print_table, without_empty
from headway_launch.runner.calibration import Expectation, Pace, calibrate
from headway_launch.runner.jobs import CellPlan, share_cores
from headway_launch.studies.plan import StudyProgress


def print_estimate(standings: Sequence[StudyProgress], cells: Sequence[CellPlan]) -> int:
    """List the runs of a session, then estimate what those that are left take; returns the exit code.
    Nothing is written to the store.

    Raises HeadwayError if what is to be measured cannot run.
    """
    planned = [job for cell in cells for job in cell.jobs]
    config = cells[0].experiment.config
    named = [cell.label or cell.experiment.algo_name for cell in cells]
    kinds = [
        (name, *kind)
        for name, standing, cell in zip(named, standings, cells, strict=True)
        for kind in _what_happens(standing, cell)
    ]
    print_table(("cell", "seeds", "runs", "what happens"), kinds, f"study {config.study}")
    if not planned:
        print_line("headway: nothing is left to train")
        return 0
    print(flush=True)  # the list is there while its cells are measured
    shares = share_cores(config.backend, planned, usable_cores())
    paces, modes = calibrate([cell for cell in cells if cell.jobs], shares)
    rows: list[tuple[Cell, ...]] = []
    expected: list[Expectation] = []
    for name, cell in zip(named, cells, strict=True):
        if cell.jobs:
            of_cell = [paces[id(cell)].estimate(cell.experiment.config, job.iteration) for job in cell.jobs]
            rows.append(
                (name, len(of_cell), sum(job.seconds for job in of_cell) / len(of_cell), *_used(of_cell))
            )
            expected += of_cell
    columns = ("cell", "trainings", "s each", "CPU s in all", "kWh in all", "kg CO2eq in all")
    known, cells_known = without_empty(columns, rows, columns[-1:])
    print_table(known, cells_known, spare=known[:3:-1])
    _print_totals(expected, shares.parallel, list(paces.values()), modes, config.backend.name)
    runs = sum(len(job.seeds) for job in planned)
    if runs != len(planned):
        most = max(len(job.seeds) for job in planned)
        print(
            f"{counted(runs, 'run')} in {counted(len(planned), 'training')}: a training is a stack of up to "
            f"{most} seeds (backend.stack), each a run of its own in the store."
        )
    return 0


def makespan(seconds: Sequence[float], parallel: int) -> float:
    """How long jobs take together, each begun in order when one of `parallel` places is free."""
    free = [0.0] * max(parallel, 1)
    heapify(free)
    for each in seconds:
        heapreplace(free, free[0] + each)
    return max(free)


def spans(numbers: Sequence[int]) -> str:
    """`0..3,7`: rising numbers that follow each other as their first and last."""
    parts: list[list[int]] = []
    for number in numbers:
        if parts and number == parts[-1][-1] + 1:
            parts[-1].append(number)
        else:
            parts.append([number])
    return ",".join(f"{part[0]}..{part[-1]}" if len(part) > 2 else ",".join(map(str, part)) for part in parts)


def _what_happens(standing: StudyProgress, cell: CellPlan) -> list[tuple[str, int, str]]:
    """Seeds, their number, and what happens to them."""
    kinds: dict[str, list[int]] = {}
    for job in cell.jobs:
        whole = cell.experiment.config.iterations
        what = f"goes on at iteration {job.iteration} of {whole}" if job.resumed else "begins"
        kinds.setdefault(what, []).extend(job.seeds)
    there = {"has finished": standing.finished, "runs elsewhere": standing.elsewhere}
    kinds |= {what: [run.record.seed for run in runs] for what, runs in there.items() if runs}
    return [(spans(seeds), len(seeds), what) for what, seeds in kinds.items()]


def _used(expected: Sequence[Expectation]) -> tuple[float, float | None, float | None]:
    """CPU s, kWh and kg CO2eq of some trainings; None where energy is not measured."""
    known = [each.kwh for each in expected if each.kwh is not None]
    emitted = [each.kg_co2 for each in expected if each.kg_co2 is not None]
    cpu_s = sum(each.cpu_s for each in expected)
    return cpu_s, sum(known) if known else None, sum(emitted) if emitted else None


def _print_totals(
    expected: Sequence[Expectation], parallel: int, paces: Sequence[Pace], modes: str, backend: str
) -> None:
    wall = makespan([each.seconds for each in expected], parallel)
    cpu_s, kwh, kg = _used(expected)
    energy = ", energy not measured" if kwh is None else f", {kwh:.3g} kWh"
    energy += "" if kg is None else f", {kg:.3g} kg CO2eq"
    print(
        f"\n{counted(len(expected), 'training')}, {parallel} at once: about {duration(wall)}, "
        f"{cpu_s:,.0f} CPU s{energy}"
    )
    fewest = min(pace.iterations for pace in paces)
    cells = "the cell" if len(paces) == 1 else f"each of {len(paces)} cells"
    print(
        f"The estimate rests on {fewest} iterations or more and one evaluation of {cells},"
        f" measured just now with {parallel} processes at once; later iterations are taken to be as long and "
        "this machine to be as busy."
    )
    if backend == "ray":
        print(
            "It was measured with training processes on this machine: placed on a cluster, with other "
            "processors or more of them, trainings take other times."
        )
    if kwh is not None:
        print(f"Energy: what CodeCarbon gave a CPU second meanwhile; {modes}.")
