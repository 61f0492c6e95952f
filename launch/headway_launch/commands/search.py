"""`headway search`: search hyper-parameters, with one budget for all algorithms that are compared."""

import argparse
import shlex
import sys
from typing import TYPE_CHECKING

from headway.contracts.errors import HeadwayError
from headway_launch.commands.arguments import add_config_dir_argument, add_dry_run_argument

if TYPE_CHECKING:
    from collections.abc import Sequence

    from headway_launch.experiments.search import AlgorithmSearch
    from headway_launch.studies.search_session import SearchSession

EXAMPLES = """\
examples:
  headway search toy_tracking
  headway search toy_tracking --show
  headway search bus_line candidates=3 env_steps=100_000 study=bus_line_quick
  headway search bus_line --dry-run

A search is a file of configs/search: an experiment, the algorithms that are compared, one budget for each of
them (candidates and env_steps), and their search spaces, from pieces in configs/space. KEY=VALUE sets a key
of the search (`headway list schema search`) or of all its runs. Candidates are drawn by Optuna, in the extra
`search`, and are runs of the store; repeating the command continues an interrupted search. Candidates train
on seeds from 9001 on, which no study reports.
It ends with the best candidates, their cost, the expected best of n candidates as a table and as a picture,
and a preset with the best candidate of each algorithm; if entries of `algorithms` share one, each has a
preset too.
`headway list searches` lists the searches.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the search and overrides of its keys and of its runs."""
    parser.add_argument("search", metavar="SEARCH", help="a file of configs/search, without .yaml")
    parser.add_argument(
        "overrides", metavar="KEY=VALUE", nargs="*", default=[], help="keys of the search, or of every run"
    )
    add_config_dir_argument(parser)
    add_dry_run_argument(parser)
    parser.add_argument("--show", action="store_true", help="print the results so far, without training")


def execute(arguments: argparse.Namespace) -> int:
    """Train the candidates and print the results; return the exit code."""
    from headway_launch.console.output import print_line
    from headway_launch.experiments.search import read_search
    from headway_launch.runner.runner import EXIT_DONE
    from headway_launch.studies.search_session import SearchSession

    parts = read_search(arguments.search, arguments.overrides)
    if arguments.dry_run:
        return _dry_run(parts)
    if arguments.show and not (database := SearchSession(parts, stored=False).database).is_file():
        raise HeadwayError(f"search {arguments.search} has not begun: there is no {database}")
    session = SearchSession(parts)
    if arguments.show:
        try:
            session.require_settings()
        except HeadwayError as error:
            print_line(f"headway: {error}; costs cannot be shown")
    code = EXIT_DONE if arguments.show else session.run(arguments.debug)
    if code == EXIT_DONE:
        _print(session, arguments.search)
    else:
        print_line("headway: stopped; the same command continues the search")
    return code


def _dry_run(parts: "Sequence[AlgorithmSearch]") -> int:
    from headway_launch.studies.dry_run import print_search_estimate
    from headway_launch.studies.search_session import SearchSession

    session = SearchSession(parts, stored=False)
    ended = {part.label: 0 for part in parts}
    if session.database.is_file():
        begun = SearchSession(parts)
        begun.require_settings()
        for part in parts:
            ended[part.label] = sum(each.trial.state != "RUNNING" for each in begun.candidates(part))
    return print_search_estimate(session, ended)


def _print(session: "SearchSession", name: str) -> None:
    """Print the results of a search and write its picture and its preset."""
    from headway_launch.console.output import ignore_closed_pipe, own_name, print_line, print_notice, relative
    from headway_launch.experiments.options import own_folder
    from headway_launch.studies.search_results import (
        presets_of,
        print_results,
        results_of,
        task_words,
        write_picture,
        write_preset,
    )

    results = results_of(session)
    with ignore_closed_pipe(sys.stdout):
        print_results(results)
    picture = session.database.with_suffix(".png")
    if write_picture(results, picture):
        print_line(f"expected best of n candidates: {relative(picture)}")
    # Beside the experiment and the preset that the search began from, if they are the user's own.
    folder = own_folder() or session.database.parent
    notes = list[str]()
    for stem, winners in presets_of(results, session.database.stem).items():
        preset = folder / "preset" / f"{stem}.yaml"
        notes += write_preset(winners, preset, name)
        labels = ", ".join(winner.part.label for winner in winners.values())
        words = [
            *task_words(next(iter(winners.values())).part),
            f"preset={stem}",
            f"algo={','.join(winners)}",
        ]
        command = shlex.join(["sweep", "--config-dir", relative(folder), *words, "seed=0..9"])
        print_line(f"preset {relative(preset)} ({labels}); use it with: {own_name()} {command}")
    for line in notes:
        print_notice(line)
