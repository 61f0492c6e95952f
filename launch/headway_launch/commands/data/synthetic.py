"""`headway data synthetic`: a scenario from a seed and the numbers fitted to Salvador's buses."""

import argparse

from headway.contracts.errors import HeadwayError
from headway_launch.commands.data.writing import (
    add_output_arguments,
    check_output,
    tell_written,
    write_scenario,
)
from headway_launch.console.progress_display import CountedProgress

EXAMPLES = """\
examples:
  headway data synthetic towns/line --size line
  headway data synthetic towns/city --size city --seed 7
  headway run env=bus env.args.scenario=towns/city algo=ippo preset=bus_lines env_steps=28_500

sizes, with the buses that run at once on a weekday:
  line       1 line, 14 buses
  corridor   10 lines, 110 buses, which share no stop
  district   40 lines, about 440 buses, on common streets and stops
  city       382 lines, about 1,360 buses

The same size and seed give the same scenario. `env.args.scenario=city env.args.scenario_seed=7` makes the
same one anew at each start; a folder can be looked at, changed and kept.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The folder, the size and the seed."""
    from headway_envs.bus.config import SCENARIOS

    add_output_arguments(parser)
    parser.add_argument("--size", choices=SCENARIOS, default="line", help="(default: line)")
    parser.add_argument("--seed", type=int, default=0, help="of geometry and demand (default: 0)")


def execute(arguments: argparse.Namespace) -> int:
    """Generate, write and say what."""
    if arguments.seed < 0:
        raise HeadwayError(f"--seed must be at least 0, not {arguments.seed}")
    out = check_output(arguments)
    from headway_envs.bus.scenario.synthetic import generate, line_count

    with CountedProgress("lines with a timetable", line_count(arguments.size)) as counted:
        tables = generate(arguments.size, arguments.seed, counted.add)
    write_scenario(tables, out)
    tell_written(tables, out)
    return 0
