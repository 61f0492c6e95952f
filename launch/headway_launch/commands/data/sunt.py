"""`headway data sunt`: write a scenario of Salvador's buses from SUNT's raw files."""

import argparse
from pathlib import Path

from headway_launch.commands.data.arguments import add_selection_arguments, selection_of
from headway_launch.commands.data.writing import add_output_arguments, check_output, write_scenario

EXAMPLES = """\
examples:
  headway data sunt SUNT/data towns/salvador
  headway data sunt SUNT/data towns/line --lines 1211
  headway data sunt SUNT/data towns/salvador --weekday 2024-08-26 --sunday 2024-09-15
  headway run env=bus env.args.scenario=towns/line algo=mappo

RAW is a folder that holds, at any depth, SUNT's files (https://github.com/LabIA-UFBA/SUNT, CC BY 4.0):
  od-YYYY-MM-DD.parquet                      trip records of at least one weekday or Sunday
  gtfs_bus_topique_*.parquet                 positions of stops
  node_temporal_features_DD-MM-YYYY.parquet  counts by stop, for demand on days without fare data
Trips are taken from one day of each day type, travel times from all its days. meta.json names the source and
the licence, describes the origin of each table, and counts omitted and corrected records.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the files, the folder and the selection."""
    parser.add_argument("raw", metavar="RAW", help="folder with SUNT's files")
    add_output_arguments(parser)
    add_selection_arguments(parser, "demand without counts")


def execute(arguments: argparse.Namespace) -> int:
    """Import the files, write the scenario and print a summary."""
    selection = selection_of(arguments)
    out = check_output(arguments)
    from headway_envs.bus.scenario.sunt.importer import SuntOptions, import_sunt

    write_scenario(import_sunt(Path(arguments.raw), SuntOptions(**selection)), out)
    return 0
