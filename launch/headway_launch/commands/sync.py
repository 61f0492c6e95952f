"""`headway sync`: send run data that MLflow lacks."""

import argparse

from headway.wording import counted
from headway_launch.commands.arguments import add_store_argument, existing_store

EXAMPLES = """\
examples:
  headway sync                                     each run to its server, else the store's database
  headway sync --to http://127.0.0.1:5000          all runs to this MLflow server

The run folders hold the complete data, and nothing is sent twice: this sends the data that MLflow lacks. Runs
whose session is sending them to a server are skipped.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the tracking URI and the store."""
    parser.add_argument("--to", metavar="URI", help="tracking URI for all runs (default: each run's own)")
    add_store_argument(parser, archives=False)


def execute(arguments: argparse.Namespace) -> int:
    """Send the missing data."""
    from headway.store.tracking.client import require_answer
    from headway.store.tracking.sync import sync, sync_each

    root = existing_store(arguments.store).resolve()
    if arguments.to:
        require_answer(arguments.to)
    done = sync(root, arguments.to) if arguments.to else sync_each(root)
    lines = [*done.failures, *done.problems, *(f"{run} is up to date in MLflow" for run in done.runs)]
    if done.attended:
        lines.append(f"{counted(done.attended, 'run')} left to the session that is sending them")
    for line in lines or ("MLflow has the data of all runs",):
        print(line)
    return 2 if done.failures else 0
