"""`headway data describe`: show lines, stops, fleet, headways and demand of a scenario."""

import argparse
from typing import TYPE_CHECKING

from headway.contracts.errors import HeadwayError
from headway_launch.commands.data.arguments import add_scenario_arguments, require_seed
from headway_launch.console.progress_display import CountedProgress

if TYPE_CHECKING:
    from headway_envs.bus.scenario.tables import Tables
    from headway_launch.console.tables import Value

EXAMPLES = """\
examples:
  headway data describe towns/city
  headway data describe towns/city --lines 50 --day-type sunday
  headway data describe towns/city --stops 5000          numbers of all stops, for env.args.disruptions
  headway data describe corridor                         a built-in one

'Most buses at once' is the largest number of buses on a trip at the same time in the timetable. Agents are
the slots that the environment creates from it, with a smoothed timetable, recovery times and every bus
assigned to one line.
Headways are mean minutes between departures of a pattern in the given hours, the median over the patterns
with at least two. Times are of the service day: 25:30 is half past one at night.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the scenario and the numbers of lines and stops to list."""
    add_scenario_arguments(parser, "day type of the lines and stops (default: the first of the scenario)")
    for what, order in (("lines", "number of trips"), ("stops", "boardings")):
        said = f"{what} to list, by {order} (default: 10; 0: none)"
        parser.add_argument(f"--{what}", type=int, default=10, help=said)


def execute(arguments: argparse.Namespace) -> int:
    """Print the tables."""
    for what in ("lines", "stops"):
        if (number := getattr(arguments, what)) < 0:
            raise HeadwayError(f"--{what} must be at least 0, not {number}")
    require_seed(arguments.seed)
    from headway_envs.bus.scenario.description import by_day_type, by_line, by_stop, meta_rows, readable
    from headway_envs.bus.scenario.source import scenario_tables
    from headway_envs.bus.scenario.tables import DAY_TYPES
    from headway_launch.console.tables import print_table, without_empty

    tables = scenario_tables(arguments.scenario, arguments.seed)
    with CountedProgress("day types described", len(DAY_TYPES)) as progress:
        days = by_day_type(tables, progress.add)
    if not days:
        raise HeadwayError(f"scenario '{arguments.scenario}' has no trips on weekdays or Sundays")
    print_table(("quantity", "value"), [*_sizes(tables), *meta_rows(tables.meta)], title=arguments.scenario)
    print()
    rows: list[tuple[Value, ...]] = [
        (label, *(readable(day, field) for day in days)) for field, label in type(days[0]).LABELS.items()
    ]
    print_table(("quantity per day", *(day.day_type for day in days)), rows)
    chosen = arguments.day_type or days[0].day_type
    if chosen not in {day.day_type for day in days}:
        raise HeadwayError(f"--day-type: there are no trips on a {chosen}; omit the option")
    if arguments.lines:
        lines = by_line(tables, chosen)
        print()
        print_table(
            tuple(lines[0].LABELS.values()),
            [tuple(readable(line, field) for field in line.LABELS) for line in lines[: arguments.lines]],
            title=f"{min(arguments.lines, len(lines))} of {len(lines)} lines, {chosen}",
        )
    if arguments.stops:
        stops = by_stop(tables, chosen)
        print()
        columns = ("stop", "name", "lines", "boardings")
        print_table(
            *without_empty(columns, stops[: arguments.stops], ("name",)),
            title=f"{min(arguments.stops, len(stops))} of {len(stops)} stops, {chosen}",
        )
    return 0


def _sizes(tables: "Tables") -> list[tuple["Value", ...]]:
    return [
        ("lines", int(tables.patterns["line"].nunique())),
        ("patterns", len(tables.patterns)),
        ("stops", len(tables.stops)),
        ("links", len(tables.links)),
        ("links, km", round(float(tables.links["leg_m"].sum()) / 1000.0, 1)),
    ]
