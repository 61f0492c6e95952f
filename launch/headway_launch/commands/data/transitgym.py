"""`headway data transitgym`: write a scenario from a line in TransitGym's tables."""

import argparse
from pathlib import Path

from headway_launch.commands.data.writing import add_output_arguments, check_output, write_scenario

EXAMPLES = """\
examples:
  headway data transitgym multiline_data/SG_43_1 towns/sg43
  headway run env=bus env.args.scenario=towns/sg43 algo=mappo

FOLDER holds a line as TransitGym (the simulator of CAAC, github.com/TransitGym) reads it. Columns (others are
ignored):
  stops.txt       stop_id, stop_lat, stop_lon; if all are 0, the stops are placed on a straight road
  trips.txt       trip_id, route_id
  stop_times.txt  trip_id, stop_id, arrival_time, shape_dist_traveled (km from the first stop)
  demand.csv      BOARDING_STOP_STN, ALIGHTING_STOP_STN, Ride_Start_Time: one row per ride of a day
Times are HH:MM:SS, with or without a date before. Every trip and ride is taken as a weekday's. Link times are
means of the planned times by hour; their spread is fitted to Salvador's buses (SUNT). Rides without an
alighting stop are left out, as in TransitGym, which also doubles the demand and adds a mirrored way back:
neither is done here. A line in one direction only has its buses drive back empty.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the files and the folder."""
    parser.add_argument("folder", metavar="FOLDER", help="folder of TransitGym's tables")
    add_output_arguments(parser)


def execute(arguments: argparse.Namespace) -> int:
    """Import the files, write the scenario and print a summary."""
    out = check_output(arguments)
    from headway_envs.bus.scenario.csv_files.transitgym import import_transitgym

    write_scenario(import_transitgym(Path(arguments.folder)), out)
    return 0
