"""`headway run`: train an experiment."""

import argparse

EXAMPLES = """\
examples:
  headway run experiment=bus_mappo
  headway run experiment=bus_mappo seed=0..4 algo.lr=3e-4 env_steps=1e6
  headway run experiment=bus_mappo algo=ippo preset=paper
  headway run env=trivial algo=ippo backend=serial energy=off env_steps=50_000
  headway run experiment=bus_mappo seed=0..9 --dry-run

KEY=VALUE sets a key of the experiment: see `headway list keys`, `headway list algos mappo`,
`headway list envs bus`. GROUP=OPTION selects a file of configs/GROUP: env, algo, rollout, backend,
store, energy, preset, experiment. Seeds: 7, 0,1,2, [0,1], 0..49 or range(0,50).
Ctrl-C stops with a checkpoint (exit code 130); `headway resume` continues. Each `headway run` creates
new runs; `headway sweep` trains only runs that the store lacks.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the overrides and --dry-run."""
    parser.add_argument("overrides", metavar="KEY=VALUE", nargs="*", help="overrides, in Hydra's grammar")
    add_dry_run_argument(parser)


def add_dry_run_argument(parser: argparse.ArgumentParser) -> None:
    """Add --dry-run, shared by the commands that train."""
    parser.add_argument(
        "--dry-run",
        action="store_true",
        help="list the runs and estimate time and energy, from the finished runs of each cell or from a few "
        "iterations; stores nothing",
    )


def execute(arguments: argparse.Namespace) -> int:
    """Train; return the exit code."""
    from headway_launch.experiments.compose import compose
    from headway_launch.runner.jobs import CellPlan, plan_jobs

    experiment = compose(arguments.overrides)
    cells = [CellPlan(experiment, plan_jobs(experiment))]
    if arguments.dry_run:
        from headway_launch.studies.dry_run import print_estimate
        from headway_launch.studies.plan import StudyProgress

        return print_estimate([StudyProgress.untouched(experiment)], cells)
    from headway_launch.runner.runner import Runner

    return Runner(cells, arguments.debug).run()
