"""`headway data sunt`: a scenario of Salvador's buses, from raw files of SUNT."""

import argparse
from pathlib import Path

from headway.contracts.errors import HeadwayError
from headway_launch.commands.data.choices import date_of, names_of
from headway_launch.commands.data.writing import (
    add_output_arguments,
    check_output,
    tell_written,
    write_scenario,
)

EXAMPLES = """\
examples:
  headway data sunt SUNT/data towns/salvador
  headway data sunt SUNT/data towns/line --lines 1211
  headway data sunt SUNT/data towns/salvador --weekday 2024-08-26 --sunday 2024-09-15
  headway run env=bus env.args.scenario=towns/line algo=mappo

RAW is a folder that holds, at any depth, files of SUNT (https://github.com/LabIA-UFBA/SUNT, CC BY 4.0):
  od-YYYY-MM-DD.parquet                      trip records; at least one weekday or Sunday
  gtfs_bus_topique_*.parquet                 where stops lie
  node_temporal_features_DD-MM-YYYY.parquet  counts by stop, for the demand of days without fares
Trips are those of one day of each day type, travel times those of all its days. meta.json names the source
and the licence, says what each table is made from, and counts what was left out or mended.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The files, the folder, and what to take."""
    parser.add_argument("raw", metavar="RAW", help="folder with files of SUNT")
    add_output_arguments(parser)
    parser.add_argument("--weekday", metavar="DATE", help="of the timetable (default: that of most trips)")
    parser.add_argument("--sunday", metavar="DATE", help="of the timetable (default: that of most trips)")
    parser.add_argument("--lines", help="names of lines, with commas (default: all)")
    parser.add_argument("--seed", type=int, default=0, help="of demand where no counts are (default: 0)")


def execute(arguments: argparse.Namespace) -> int:
    """Read, write and say what."""
    if arguments.seed < 0:
        raise HeadwayError(f"--seed must be at least 0, not {arguments.seed}")
    weekday, sunday = date_of("weekday", arguments.weekday), date_of("sunday", arguments.sunday)
    out = check_output(arguments)
    from headway_envs.bus.scenario.sunt.importer import SuntOptions, import_sunt

    options = SuntOptions(weekday, sunday, names_of(arguments.lines), arguments.seed)
    tables = import_sunt(Path(arguments.raw), options)
    write_scenario(tables, out)
    tell_written(tables, out)
    return 0
