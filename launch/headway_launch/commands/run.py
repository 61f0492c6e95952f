"""`headway run`: train an experiment."""

import argparse

from headway_launch.commands.arguments import add_dry_run_argument, add_experiment_arguments

EXAMPLES = """\
examples:
  headway run experiment=bus_mappo
  headway run experiment=bus_mappo seed=0..4 algo.lr=3e-4 env_steps=1e6
  headway run experiment=bus_mappo algo=ippo preset=paper
  headway run env=trivial algo=ippo backend=serial energy=off env_steps=50_000
  headway run experiment=bus_mappo seed=0..9 --dry-run
  headway run lab/mine.yaml seed=0..4          an experiment in a file of your own
  headway run --config-dir lab experiment=mine

KEY=VALUE sets a key of the experiment: see `headway list keys`, `headway list algos mappo`,
`headway list envs bus`. GROUP=OPTION chooses an option of env, algo, preset, backend, energy or experiment:
a file configs/GROUP/OPTION.yaml, or a registered name. Seeds: 7, 0,1,2, [0,1], 0..49 or range(0,50).
Ctrl-C stops with a checkpoint (exit code 130); `headway resume` continues. Each `headway run` creates
new runs; `headway sweep` trains only runs that the store lacks.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the experiment with its overrides, and the options."""
    add_experiment_arguments(parser)
    add_dry_run_argument(parser)


def execute(arguments: argparse.Namespace) -> int:
    """Train; return the exit code."""
    from headway_launch.experiments.compose import compose
    from headway_launch.experiments.notices import print_notices
    from headway_launch.runner.jobs import CellPlan, plan_jobs

    experiment = compose(arguments.overrides)
    cells = [CellPlan(experiment, plan_jobs(experiment))]
    print_notices(arguments.overrides, [experiment])
    if arguments.dry_run:
        from headway_launch.studies.dry_run import print_estimate

        return print_estimate(cells)
    from headway_launch.runner.runner import Runner

    return Runner(cells, arguments.debug).run()
