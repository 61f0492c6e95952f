"""`headway data realism`: compare simulated days with measured data."""

import argparse
import csv
import sys
from collections.abc import Sequence
from dataclasses import replace
from math import isnan
from pathlib import Path
from typing import TYPE_CHECKING

from headway.contracts.errors import HeadwayError
from headway.wording import counted
from headway_launch.commands.data.arguments import day_type_of
from headway_launch.console.progress_display import CountedProgress

if TYPE_CHECKING:
    from headway_envs.bus.config import BusConfig
    from headway_envs.bus.realism.comparison import Row

EXAMPLES = """\
examples:
  headway data realism towns/salvador
  headway data realism towns/salvador --day-type sunday --records ../sunt_raw
  headway data realism towns/mine --records counts
  headway data realism towns/salvador --days 5 --format csv > realism.csv
  headway data realism towns/salvador env.args.boarding_s=5.9

The scenario's timetable is replayed from 4 to 26 h: every trip departs at its recorded time, without added
noise, and buses always move. Each statistic is the mean over simulated days, beside the measured value, with
a verdict: whether they differ by at most the tolerance. Trips and boardings are measured in the scenario's
own tables; headways along the route, dwells and loads in the records of its lines (--records: SUNT's, or the
calls.csv of `headway data csv`) or, for scenarios imported from SUNT, in those of the whole city, which are
not used to judge an extract of a few lines.
Headways are divided by the mean headway of the two-hour period, as is usual for frequent service; CV is their
coefficient of variation, and headways below a quarter of the mean count as bunched. Built-in scenarios have
no recorded trips to compare.
"""
_COLUMNS = (
    "statistic",
    "simulated",
    "sd over days",
    "measured",
    "simulated - measured",
    "tolerance (+-)",
    "verdict",
    "measured in",
)
_FEW_TRIPS = 20
"""Number of trips per day below which their statistics vary too much to compare."""
_LEGEND = (
    "simulated: mean over the simulated days; sd: standard deviation between these days; verdict: whether "
    "simulated - measured lies within -tolerance to +tolerance"
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the scenario, the days and the records."""
    parser.add_argument(
        "scenario", metavar="SCENARIO", help="folder with recorded trips, of `headway data sunt` or csv"
    )
    parser.add_argument(
        "overrides", metavar="KEY=VALUE", nargs="*", default=[], help="env.args.* of the simulation"
    )
    parser.add_argument(
        "--day-type", choices=("weekday", "sunday"), help="day type (default: weekday, if it has trips)"
    )
    parser.add_argument("--days", type=int, default=20, help="days to simulate (default: 20)")
    parser.add_argument(
        "--records", metavar="RAW", help="folder of calls.csv, or of SUNT's files od-*.parquet"
    )
    parser.add_argument("--format", choices=("text", "csv"), default="text", help="output format")


def execute(arguments: argparse.Namespace) -> int:
    """Simulate, compare and print the table."""
    if arguments.days < 1:
        raise HeadwayError("--days must be at least 1")
    config = _config(arguments)
    from headway_envs.bus.config import SCENARIOS
    from headway_envs.bus.realism.comparison import compare_replay, line_count
    from headway_envs.bus.realism.measured import CITY_LINES
    from headway_envs.bus.scenario.source import scenario_tables

    if arguments.scenario not in SCENARIOS and not Path(arguments.scenario).is_dir():
        raise HeadwayError(
            f"there is no folder {arguments.scenario}: give one with recorded trips, as `headway data sunt` "
            "or csv writes them"
        )
    tables = scenario_tables(arguments.scenario, 0)
    day = day_type_of(tables, arguments.day_type)
    config = replace(config, day_type=day)
    records = Path(arguments.records) if arguments.records else None
    with CountedProgress("days simulated", arguments.days) as progress:
        rows = compare_replay(tables, config, arguments.days, records, progress.add)
    if arguments.format == "csv":
        writer = csv.writer(sys.stdout, lineterminator="\n")
        writer.writerow(_COLUMNS)
        writer.writerows(_cells(row) for row in rows)
        return 0
    from headway_launch.console.output import print_line
    from headway_launch.console.tables import print_table

    name = Path(arguments.scenario).name
    print_table(
        _COLUMNS,
        [_cells(row) for row in rows],
        title=f"{name}, {day}: replay, always MOVE, days simulated: {arguments.days}",
        spare=("sd over days", "tolerance (+-)", "simulated - measured"),
    )
    print_line(_LEGEND)
    judged = [row for row in rows if row.judged]
    trips = int((tables.trips["daytype"] == day).sum())
    if trips < _FEW_TRIPS:
        print(f"{counted(trips, 'trip')} per day: too few to compare, whatever the verdicts")
    print(f"{sum(row.holds for row in judged)} of {len(judged)} statistics are within tolerance")
    if left_out := len(rows) - len(judged):
        lines, city = line_count(tables, config), CITY_LINES[config.day_type]
        those = "that line" if lines == 1 else "those lines"
        print(
            f"not judged: {counted(left_out, 'statistic')} measured over all {city} lines of the city; the "
            f"scenario has {lines}; --records RAW measures them on {those}"
        )
    return 0


def _config(arguments: argparse.Namespace) -> "BusConfig":
    """Return the environment's arguments.

    Raises HeadwayError for other keys, for keys that have an option and for keys that a replay fixes.
    """
    from headway_envs.bus.config import BusConfig
    from headway_envs.bus.prepare import REPLAY_FIXED
    from headway_launch.experiments.compose import compose

    options = {"scenario": f"the scenario in place of {arguments.scenario}", "day_type": "--day-type"}
    for override in arguments.overrides:
        key = override.split("=")[0]
        if not key.startswith("env.args."):
            raise HeadwayError(f"{key}: only env.args.* of the bus environment can be given here")
        if key.removeprefix("env.args.") in options:
            raise HeadwayError(f"{key}: give {options[key.removeprefix('env.args.')]}")
        _refuse_fixed(key, ("scenario_seed", "start_hour", "end_hour", *REPLAY_FIXED))
    config = compose(["env=bus", *arguments.overrides]).env_config
    assert isinstance(config, BusConfig)
    return config


def _refuse_fixed(key: str, fixed: Sequence[str]) -> None:
    """Raise HeadwayError if the replay sets `key` or one of its subkeys."""
    name = key.removeprefix("env.args.")
    if name in fixed:
        raise HeadwayError(f"{key}: a replay fixes this key; omit it")
    inside = [other for other in fixed if other.startswith(f"{name}.")]
    if inside:
        raise HeadwayError(f"{key}: a replay fixes {', '.join(inside)}; give the other subkeys individually")


def _cells(row: "Row") -> tuple[str | float | None, ...]:
    return (
        row.statistic,
        None if isnan(row.simulated) else round(row.simulated, 4),
        None if row.deviation is None or isnan(row.deviation) else round(row.deviation, 4),
        round(row.measured, 4),
        None if isnan(row.off) else round(row.off, 4),
        round(row.tolerance, 4),
        ("within tolerance" if row.holds else "outside tolerance") if row.judged else "not judged",
        row.source,
    )
