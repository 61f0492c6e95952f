"""`headway data synthetic`: write a scenario generated with parameters fitted to Salvador's buses."""

import argparse

from headway_launch.commands.data.arguments import require_seed
from headway_launch.commands.data.writing import add_output_arguments, check_output, write_scenario
from headway_launch.console.progress_display import CountedProgress

EXAMPLES = """\
examples:
  headway data synthetic towns/line --size line
  headway data synthetic towns/city --size city --seed 7
  headway run experiment=bus_city study=mine seed=0 env.args.scenario=towns/city

sizes, with the buses in service at once on a weekday:
  line       1 line, 14 buses
  corridor   10 lines without common stops, 110 buses
  district   40 lines with common streets and stops, about 440 buses
  city       382 lines, about 1,360 buses

The same size and seed give the same scenario. `env.args.scenario=city env.args.scenario_seed=7` generates it
again at every start; a folder can be inspected, edited and kept.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the folder, the size and the seed."""
    from headway_envs.bus.config import SCENARIOS

    add_output_arguments(parser)
    parser.add_argument("--size", choices=SCENARIOS, default="line", help="size of the town (default: line)")
    parser.add_argument("--seed", type=int, default=0, help="seed of geometry and demand (default: 0)")


def execute(arguments: argparse.Namespace) -> int:
    """Generate and write the scenario, and print a summary."""
    require_seed(arguments.seed)
    out = check_output(arguments)
    from headway_envs.bus.scenario.synthetic import generate, line_count

    with CountedProgress("lines with a timetable", line_count(arguments.size)) as progress:
        tables = generate(arguments.size, arguments.seed, progress.add)
    write_scenario(tables, out)
    return 0
