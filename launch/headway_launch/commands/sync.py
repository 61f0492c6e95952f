"""`headway sync`: bring MLflow up to date with the run folders."""

import argparse

from headway_launch.commands.runs import add_store_argument, existing_store

EXAMPLES = """\
examples:
  headway sync                                     each run to where its store.tracking_uri was
  headway sync --to http://127.0.0.1:5000          all runs to this MLflow server

The run folders are the truth, and nothing is sent twice: after a server was away, or a session was killed,
this sends what MLflow does not have. Runs that a living session trains are left to it.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Where to, and the store."""
    parser.add_argument("--to", metavar="URI", help="a tracking URI for all runs (default: each run's own)")
    add_store_argument(parser)


def execute(arguments: argparse.Namespace) -> int:
    """Send what is missing."""
    from headway.store.tracking.client import require_answer
    from headway.store.tracking.sync import sync, sync_each

    root = existing_store(arguments.store).resolve()
    if arguments.to:
        require_answer(arguments.to)
    lines = sync(root, arguments.to) if arguments.to else sync_each(root)
    for line in lines or ("MLflow is up to date with every run that has ended",):
        print(line)
    return 0
