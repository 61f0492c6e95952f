"""`headway search`: run the hyper-parameter search defined in configs/search/NAME.yaml."""

import argparse
import sys
from statistics import mean
from typing import TYPE_CHECKING

from headway.contracts.errors import HeadwayError
from headway_launch.commands.run import add_config_dir_argument, add_dry_run_argument

if TYPE_CHECKING:
    from headway.config.experiment import ExperimentConfig

EXAMPLES = """\
examples:
  headway search bus_line
  headway search bus_line env_steps=100_000 study=bus_line_quick
  headway search bus_line --dry-run

A search is a file of configs/search: an experiment, cells (each gets its own winner) and candidates
(overrides tried in every cell). All cells have the same candidates, seeds and budget; the winner has the
highest mean final reward. All runs train in parallel; repeating the command continues an interrupted search.
Use seeds that no study reports: on the seeds that selected it, a winner looks better than it is.
`headway list searches` lists the searches.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the search and overrides of its base configuration."""
    parser.add_argument("search", metavar="SEARCH", help="a file of configs/search, without .yaml")
    parser.add_argument(
        "overrides", metavar="KEY=VALUE", nargs="*", default=[], help="overrides of every run"
    )
    add_config_dir_argument(parser)
    add_dry_run_argument(parser)
    parser.add_argument("--fresh", action="store_true", help="train all runs, including those in the store")


def execute(arguments: argparse.Namespace) -> int:
    """Train every candidate in every cell and print the winners; return the exit code."""
    from headway_launch.console.output import ignore_closed_pipe
    from headway_launch.console.tables import print_table
    from headway_launch.experiments.search import read_search
    from headway_launch.runner.runner import EXIT_DONE
    from headway_launch.studies.session import StudySession

    search = read_search(arguments.search)
    points = search.points(arguments.overrides)
    labels = [": ".join(point) for point in points]
    session = StudySession.plan(list(points.values()), labels, arguments.fresh)
    if arguments.dry_run:
        from headway_launch.studies.dry_run import print_estimate

        return print_estimate(session.progress, session.cells)
    runner = session.open_runner(arguments.debug)
    code = runner.run()
    if code != EXIT_DONE:
        return code
    session.require_all_ended(runner)
    results = {}
    for (point, experiment), rewards in zip(points.items(), runner.final_rewards(), strict=True):
        if len(rewards) < len(experiment.config.seed):
            raise HeadwayError(
                f"{': '.join(point)} has {len(rewards)} of {len(experiment.config.seed)} seeds, because "
                "another session trains the others; repeat the search when that session has ended"
            )
        results[point] = mean(rewards)
    best = {cell: max(results[cell, candidate] for candidate in search.candidates) for cell in search.cells}
    counts = {cell: [results[cell, name] for name in search.candidates].count(best[cell]) for cell in best}
    rows = [
        (cell, candidate, found, "" if found < best[cell] else "best" if counts[cell] == 1 else "tied best")
        for (cell, candidate), found in results.items()
    ]
    config = next(iter(points.values())).config
    with ignore_closed_pipe(sys.stdout):
        print_table(("cell", "candidate", "mean final reward", "rank"), rows, title=_title(config))
    return EXIT_DONE


def _title(config: "ExperimentConfig") -> str:
    seeds = ", ".join(str(seed) for seed in config.seed)
    return f"search on {config.env.id}: seeds {seeds}, {config.env_steps:,} environment steps each"
