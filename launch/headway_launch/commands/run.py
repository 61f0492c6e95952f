"""`headway run`: train an experiment."""

import argparse

EXAMPLES = """\
examples:
  headway run experiment=bus_mappo
  headway run experiment=bus_mappo seed=0..4 algo.lr=3e-4 env_steps=1e6
  headway run experiment=bus_mappo algo=ippo preset=paper
  headway run env=trivial algo=ippo backend=serial energy=off env_steps=50_000

KEY=VALUE sets any key of the experiment: `headway list keys`, `headway list algos mappo`,
`headway list envs bus`. GROUP=OPTION takes a file of configs/: env, algo, rollout, backend,
store, energy, preset, experiment. Seeds: 7, 0,1,2, [0,1], 0..49 or range(0,50).
Ctrl-C stops with a checkpoint (exit code 130); `headway resume` goes on. Every `headway run` makes
runs of its own; `headway sweep` trains only what the store does not have.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Overrides."""
    parser.add_argument("overrides", metavar="KEY=VALUE", nargs="*", help="overrides, in Hydra's grammar")


def execute(arguments: argparse.Namespace) -> int:
    """Train; returns the exit code."""
    from headway_launch.threads import limit_threads

    limit_threads()
    from headway_launch.composing import compose
    from headway_launch.conducting import Conductor
    from headway_launch.planning import CellPlan, plan_jobs

    experiment = compose(arguments.overrides)
    return Conductor([CellPlan(experiment, plan_jobs(experiment))], arguments.debug).conduct()
