"""`headway resume`: go on with runs that were stopped, killed or failed."""

import argparse

from headway.contracts.errors import HeadwayError
from headway_launch.commands.runs import add_store_argument, existing_store

EXAMPLES = """\
examples:
  headway resume bus-mappo-1f2e3d-s0-20260101-120000-ab12
  headway resume s0-20260101-1200          any part of the name that only one run has
  headway resume --study bus               all killed and failed runs of a study
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Runs or a study, and the store."""
    parser.add_argument("runs", metavar="RUN", nargs="*", help="identities as `headway runs` shows them")
    parser.add_argument("--study", help="all KILLED and FAILED runs of this study")
    add_store_argument(parser)


def execute(arguments: argparse.Namespace) -> int:
    """Go on; returns the worst exit code of the experiments gone on with."""
    from headway_launch.threads import limit_threads

    limit_threads()
    from headway.store.index import RunIndex
    from headway_launch.conducting import EXIT_STOPPED, Conductor
    from headway_launch.stored import StoredRun, jobs_to_resume

    root = existing_store(arguments.store)
    names = list(arguments.runs)
    if arguments.study:
        rows = RunIndex(root).rows(arguments.study)
        names += [row.run_id for row in rows if row.status in ("KILLED", "FAILED")]
    if not names:
        missing = (
            f"study {arguments.study} has no killed or failed runs"
            if arguments.study
            else "name a run or --study"
        )
        raise HeadwayError(f"{missing}; `headway runs` shows what is KILLED or FAILED and can go on")
    found = [StoredRun.find(root, name) for name in names]
    runs = list({run.directory: run for run in found}.values())
    for run in runs:
        if run.record.status == "FINISHED":
            raise HeadwayError(f"run {run.record.run_id} has finished: there is nothing to resume")
    worst = 0
    for jobs in jobs_to_resume(runs):
        worst = max(worst, Conductor(jobs, arguments.debug).conduct())
        if worst == EXIT_STOPPED:
            break
    return worst
