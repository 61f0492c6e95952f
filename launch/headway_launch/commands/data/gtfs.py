"""`headway data gtfs`: write a scenario from the timetable of a GTFS feed."""

import argparse
from pathlib import Path

from headway.contracts.errors import HeadwayError
from headway_launch.commands.data.arguments import add_selection_arguments, names_of, selection_of
from headway_launch.commands.data.writing import add_output_arguments, check_output, write_scenario

EXAMPLES = """\
examples:
  headway data gtfs feed.zip towns/mine
  headway data gtfs feed.zip towns/mine --weekday 2024-05-15 --sunday 2024-05-19
  headway data gtfs feed_folder towns/two --lines 10,12 --boardings-per-trip 30
  headway run env=bus env.args.scenario=towns/mine algo=mappo

Stops, patterns, links, trips and mean travel times are taken from the feed, on the weekday and the Sunday
with the most trips or on the given dates. A feed has no passengers and no variation of travel times: these
are generated with parameters fitted to Salvador's buses (SUNT). meta.json records this, and counts irregular
entries of the feed. Vehicles follow block_id; trips without it are chained at their last stops.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the feed, the folder and the selection."""
    parser.add_argument("feed", metavar="FEED", help="GTFS feed: a zip file, or a folder of .txt files")
    add_output_arguments(parser)
    add_selection_arguments(parser, "the generated demand")
    parser.add_argument("--types", help="route types, comma-separated (default: buses)")
    parser.add_argument(
        "--boardings-per-trip",
        type=float,
        default=47.0,
        help="mean on a weekday, which scales the generated demand (default: 47, as in Salvador)",
    )


def execute(arguments: argparse.Namespace) -> int:
    """Import the feed, write the scenario and print a summary."""
    selection = selection_of(arguments)
    if not 0.0 < arguments.boardings_per_trip <= 1000.0:
        raise HeadwayError(
            f"--boardings-per-trip must be above 0 and at most 1000, not {arguments.boardings_per_trip:g}"
        )
    out = check_output(arguments)
    from headway_envs.bus.scenario.gtfs.importer import BUS_TYPES, GtfsOptions, import_gtfs

    types = names_of(arguments.types) or BUS_TYPES
    options = GtfsOptions(**selection, route_types=types, boardings_per_trip=arguments.boardings_per_trip)
    write_scenario(import_gtfs(Path(arguments.feed), options), out)
    return 0
