"""`headway data csv`: write a scenario from an operator's own CSV files."""

import argparse
from pathlib import Path

from headway_launch.commands.data.writing import add_output_arguments, check_output, write_scenario

EXAMPLES = """\
examples:
  headway data csv counts towns/mine
  headway data csv counts towns/mine --replace
  headway data realism towns/mine --records counts
  headway run env=bus env.args.scenario=towns/mine algo=mappo

FOLDER holds stops.csv and lines.csv; either trips.csv and link_times.csv or calls.csv, recorded calls (AVL);
and demand.csv, unless calls.csv has boardings and alightings in every row. Columns (in brackets: optional):
  stops.csv       stop (name or code), lat, lon (degrees north and east)
  lines.csv       line, direction, stop, [distance_m]: one row per call in driving order; distance_m is that
                  from the previous stop, m (default: straight line)
  trips.csv       [day_type], line, direction, departure, arrival, [vehicle]: times HH:MM or HH:MM:SS at the
                  first and the last stop
  link_times.csv  [day_type], from_stop, to_stop, hour, mean_s, [sd_s]: time from arrival to arrival, s, of
                  buses that leave in that hour (0 to 30)
  demand.csv      [day_type], line, direction, stop, [position], hour, boardings, [alightings] or [to_stop]:
                  mean passengers of a day in that hour; to_stop makes them origin-destination counts
  calls.csv       date (YYYY-MM-DD), trip, [vehicle], line, direction, stop, [position], [arrival],
                  [departure], [boardings], [alightings]: one row per call, with one of the times at least
day_type is weekday (the default) or sunday. Times after midnight continue: 24:10. position, 1 for the first,
is needed where a direction calls at a stop several times. Values are separated by commas, or by semicolons
with decimal commas. Other columns are ignored. docs/howto/scenario.md has an example of every file.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the files and the folder."""
    parser.add_argument("folder", metavar="FOLDER", help="folder of the CSV files")
    add_output_arguments(parser)


def execute(arguments: argparse.Namespace) -> int:
    """Import the files, write the scenario and print a summary."""
    out = check_output(arguments)
    from headway_envs.bus.scenario.csv_files.importer import import_csv

    write_scenario(import_csv(Path(arguments.folder)), out)
    return 0
