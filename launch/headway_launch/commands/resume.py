"""`headway resume`: continue runs, or a whole study, that were stopped, killed or failed."""

import argparse
import shlex
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from headway.config.schema import suggestion
from headway.contracts.errors import HeadwayError
from headway_launch.commands.arguments import add_dry_run_argument, add_store_argument, existing_store

if TYPE_CHECKING:
    from headway_launch.runner.jobs import CellPlan
    from headway_launch.runner.stored_run import StoredRun

EXAMPLES = """\
examples:
  headway resume bus-mappo-1f2e3d-s0-20260101-120000-ab12
  headway resume s0-20260101-1200          any unique part of a run's name
  headway resume --study bus               a whole study: killed and failed runs, and runs
                                           that a sweep had not started

A run continues from its last checkpoint. If the environment supports snapshots (bus does), its curves equal
those of an uninterrupted run bit for bit; otherwise episodes are restarted, and the tag
`episodes_restarted` of the run holds the iterations at which they were. The table at the end has all seeds
of the cell that have finished.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the runs or the study, and the store."""
    parser.add_argument("runs", metavar="RUN", nargs="*", help="names of runs, as in `headway runs`")
    parser.add_argument("--study", help="all unfinished runs of this study")
    add_dry_run_argument(parser)
    add_store_argument(parser, archives=False)


def execute(arguments: argparse.Namespace) -> int:
    """Continue training, or estimate it; return the highest exit code of the sessions."""
    from headway_launch.console.output import print_line
    from headway_launch.runner.runner import EXIT_STOPPED, run_sessions
    from headway_launch.runner.stored_run import StoredRun
    from headway_launch.studies.dry_run import print_estimate
    from headway_launch.studies.session import require_all_ended

    for word in arguments.runs:
        if "=" in word:
            raise HeadwayError(
                f"{word}: a run continues with its own configuration; omit this, or train a new run with "
                "it by `headway run`"
            )
    root = existing_store(arguments.store)
    if not arguments.runs and not arguments.study:
        raise HeadwayError(
            "name a run or --study; `headway runs` shows which runs are KILLED or FAILED and can be resumed"
        )
    found = [StoredRun.find(root, name) for name in arguments.runs]
    runs = list({run.directory: run for run in found}.values())
    for run in runs:
        if run.record.status == "FINISHED":
            raise HeadwayError(f"run {run.record.run_id} has finished: there is nothing to resume")
        run.record.require_free()
    study = arguments.study
    cells, held = _cells_of_study(root, study, runs) if study else (_cells_of(runs), [])
    if arguments.dry_run and cells:
        return print_estimate(cells)
    code, left = run_sessions(cells, arguments.debug, plan_kept=bool(study))
    if code != EXIT_STOPPED:
        require_all_ended(study or runs[0].record.study, [*held, *left], may_leave=True)
    if not cells and not held:
        name = shlex.quote(study)
        print_line(
            f"headway: all runs of study {study} have finished: there is nothing to resume; for the results: "
            f"headway compare {name}, headway report {name}"
        )
    return code


def _cells_of(runs: Sequence["StoredRun"]) -> list["CellPlan"]:
    """Return the cells of `runs`, whose results include the finished runs of other seeds."""
    from headway_launch.runner.jobs import CellPlan
    from headway_launch.runner.stored_run import jobs_to_resume
    from headway_launch.studies.plan import cell_labels

    batches = jobs_to_resume(runs, {})
    labels = cell_labels([jobs[0].experiment for jobs in batches])
    by_id = {run.record.run_id: run for run in runs}
    cells = []
    for jobs, label in zip(batches, labels, strict=True):
        experiment, config = jobs[0].experiment, jobs[0].experiment.config
        finished = _finished_beside(by_id[jobs[0].resumed[0]], config.seed)
        seeds = tuple(sorted({*config.seed, *finished}))
        experiment = replace(experiment, config=replace(config, seed=seeds))
        cells.append(CellPlan(experiment, jobs, tuple(finished.values()), label))
    return cells


def _finished_beside(run: "StoredRun", resumed: Sequence[int]) -> dict[int, Path]:
    """Return the folder of the newest finished run of each other seed with the configuration of `run`."""
    from headway.store.index import RunIndex
    from headway_launch.runner.stored_run import StoredRun

    found = {}
    for row in RunIndex(run.store).rows(run.record.study):
        if row.cell == run.record.cell and row.status == "FINISHED" and row.seed not in resumed:
            with suppress(HeadwayError):  # damaged
                if StoredRun.read(run.store, Path(row.directory)).identity == run.identity:
                    found[row.seed] = Path(row.directory)
    return found


def _cells_of_study(
    root: Path, study: str, named: Sequence["StoredRun"]
) -> tuple[list["CellPlan"], list[Path]]:
    """Return the cells left to train, and the folders of other runs that are being trained.

    The cells are those of the study's sweeps, then of its other unfinished runs and the `named` runs.
    """
    from headway.store.index import RunIndex
    from headway.store.run_folder import search_database
    from headway_launch.runner.stored_run import StoredRun
    from headway_launch.studies.plan import StudyProgress, cell_labels, kept_plans, plan_cells
    from headway_launch.studies.session import print_progress

    if search_database(root, study).is_file():
        raise HeadwayError(
            f"study {study} is a search, which has runs that are not meant to be continued: repeat its "
            "`headway search`, or name single runs"
        )
    everything = RunIndex(root).rows()
    rows = [row for row in everything if row.study == study]
    planned = kept_plans(root, study)
    if not rows and not planned:
        studies = {row.study for row in everything}
        raise HeadwayError(f"there is no study {study!r} in {root}; {suggestion(study, studies)}")
    standings = [StudyProgress.of(root, experiment, rows) for experiment in planned]
    print_progress(study, standings)
    covered = {run_id for standing in standings for run_id in standing.run_ids or ()}
    free = [Path(row.directory) for row in rows if row.status in ("KILLED", "FAILED")]
    stopped = (*named, *(StoredRun.read(root, folder) for folder in free if folder.name not in covered))
    others = {run.directory: run for run in stopped if run.record.run_id not in covered}
    cells = [*plan_cells(standings), *_cells_of(list(others.values()))]
    labels = cell_labels([cell.experiment for cell in cells])
    held = [Path(row.directory) for row in rows if row.status == "RUNNING" and row.run_id not in covered]
    return [replace(cell, label=label) for cell, label in zip(cells, labels, strict=True)], held
