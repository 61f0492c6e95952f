"""`headway data plot`: a scenario as a picture."""

import argparse
from pathlib import Path

from headway.contracts.errors import HeadwayError
from headway_launch.console.output_files import write_figure

EXAMPLES = """\
examples:
  headway data plot towns/city --output city.png
  headway data plot towns/city --output city.pdf --day-type sunday
  headway data plot corridor --output corridor.png       a built-in one

The map shows links as wide as the passengers whom they carry, stops as large as their boardings; up to ten
lines each have a colour, more are coloured by the minutes between buses on a link. Beside it, by hour: buses
on the road, boardings, and headways.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The scenario and the file."""
    parser.add_argument("scenario", metavar="SCENARIO", help="folder, or line, corridor, district or city")
    parser.add_argument("--output", metavar="PNG", help="picture to write (default: NAME.png)")
    parser.add_argument(
        "--day-type", choices=("weekday", "sunday"), help="(default: the weekday, if it has trips)"
    )
    parser.add_argument("--seed", type=int, default=0, help="of a built-in scenario (default: 0)")


def execute(arguments: argparse.Namespace) -> int:
    """Draw the picture and say where it is."""
    if arguments.seed < 0:
        raise HeadwayError(f"--seed must be at least 0, not {arguments.seed}")
    from headway_envs.bus.scenario.plots import draw_scenario
    from headway_envs.bus.scenario.source import scenario_tables

    name = Path(arguments.scenario).name
    output = Path(arguments.output or f"{name}.png")
    tables = scenario_tables(arguments.scenario, arguments.seed)
    there = set(tables.trips["daytype"])
    day = arguments.day_type or ("weekday" if "weekday" in there else "sunday")
    lines = tables.patterns["line"].nunique()
    title = f"{name}: {lines:,} lines, {len(tables.stops):,} stops, {day}"
    write_figure(draw_scenario(tables, day, title), output)
    print(output)
    return 0
