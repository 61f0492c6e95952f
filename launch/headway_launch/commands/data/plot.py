"""`headway data plot`: plot a map of a scenario with loads and headways."""

import argparse
from pathlib import Path

from headway.wording import counted
from headway_launch.commands.data.arguments import add_scenario_arguments, day_type_of, require_seed
from headway_launch.console.output_files import write_figure

EXAMPLES = """\
examples:
  headway data plot towns/city --output city.png
  headway data plot towns/city --output city.pdf --day-type sunday
  headway data plot corridor --output corridor.png       a built-in one

On the map, the width of a link shows its passengers and the size of a stop its boardings. Up to ten lines
have one colour each; with more lines, colours show the minutes between buses on a link. Beside the map, by
hour: buses in service, boardings and headways.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the scenario and the file."""
    add_scenario_arguments(parser, "day type (default: weekday, if it has trips)")
    parser.add_argument("-o", "--output", metavar="PNG", help="picture to write (default: NAME.png)")


def execute(arguments: argparse.Namespace) -> int:
    """Plot, and print the path of the picture."""
    require_seed(arguments.seed)
    from headway_envs.bus.scenario.plots import plot_scenario
    from headway_envs.bus.scenario.source import scenario_tables

    name = Path(arguments.scenario).name
    output = Path(arguments.output or f"{name}.png")
    tables = scenario_tables(arguments.scenario, arguments.seed)
    day = day_type_of(tables, arguments.day_type)
    lines = counted(tables.patterns["line"].nunique(), "line")
    title = f"{name}: {lines}, {counted(len(tables.stops), 'stop')}, {day}"
    write_figure(plot_scenario(tables, day, title), output)
    print(output)
    return 0
