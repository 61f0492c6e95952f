"""`headway sweep`: train every combination of values and seeds, as far as the store does not have them."""

import argparse

from headway_launch.commands.run import add_dry_run_argument

EXAMPLES = """\
examples:
  headway sweep experiment=bus_mappo seed=0..49
  headway sweep experiment=bus_mappo algo=ippo,mappo seed=0..9 backend.parallel=8
  headway sweep env=bus algo=ippo,mappo,ia2c 'algo.lr=choice(1e-3,3e-4)' 'seed=range(0,10)' study=rates
  headway sweep experiment=bus_mappo algo=ippo,mappo seed=0..9 --dry-run

KEY=VALUE as for `headway run`; several values, in Hydra's grammar, make a cell each: a,b, choice(a,b),
range(0,5), for an option of a group glob(*). All cells and seeds train side by side, as many at once as
there are cores. The same sweep given again goes on where it stopped: runs that have finished are left
alone, those that stopped go on from their checkpoints. A changed configuration is a new cell of the study.
Exit code: 0 all have finished, 2 some failed (the others have gone on), 130 stopped.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Overrides, and what to do with them."""
    parser.add_argument("overrides", metavar="KEY=VALUE", nargs="*", help="overrides, in Hydra's grammar")
    add_dry_run_argument(parser)
    parser.add_argument("--fresh", action="store_true", help="train anew what the store has, too")


def execute(arguments: argparse.Namespace) -> int:
    """Train; returns the exit code."""
    from headway_launch.threads import limit_threads

    limit_threads()
    from headway_launch.study_plan import distinct
    from headway_launch.studying import StudySession
    from headway_launch.sweeping import compose_sweep

    session = StudySession.plan(distinct(compose_sweep(arguments.overrides)), fresh=arguments.fresh)
    if arguments.dry_run:
        from headway_launch.estimating import print_estimate

        return print_estimate(session.standings, session.cells)
    return session.conductor(arguments.debug).conduct()
