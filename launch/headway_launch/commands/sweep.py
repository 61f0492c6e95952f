"""`headway sweep`: train every combination of values and seeds that is not in the store."""

import argparse
import shlex

from headway.contracts.errors import HeadwayError
from headway_launch.commands.arguments import add_dry_run_argument, add_experiment_arguments

_ALLOCATION = ("nodes", "cpus", "time", "partition")

EXAMPLES = """\
examples:
  headway sweep experiment=bus_mappo seed=0..49
  headway sweep experiment=bus_mappo algo=ippo,mappo seed=0..9 backend.parallel=8
  headway sweep env=bus algo=ippo,mappo,ia2c 'algo.lr=choice(1e-3,3e-4)' 'seed=range(0,10)' study=rates
  headway sweep experiment=bus_mappo algo=ippo,mappo seed=0..9 --dry-run
  headway sweep experiment=bus_mappo seed=0..49 --slurm --nodes 4 --cpus 32 --time 12:00:00
  headway sweep experiment=bus_mappo seed=0..49 --slurm --array --cpus 8 --time 12:00:00

KEY=VALUE as for `headway run`; several values in Hydra's grammar make one cell each: a,b, choice(a,b),
range(0,5), or glob(*) for options of a group. All cells and seeds train in parallel, as many at a time as
there are cores. Repeating a sweep continues it: finished runs are kept, stopped runs continue from their
checkpoints. A changed configuration is a new cell of the study. The same sweep started several times at once
on one machine divides the runs among its sessions.
With --slurm, nothing is trained; a script for sbatch is written and its path printed.
Exit code: 0 all runs have finished, or other sessions train the rest; 2 some failed (the others were
completed); 130 interrupted.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the overrides and the options of Slurm."""
    add_experiment_arguments(parser)
    add_dry_run_argument(parser)
    parser.add_argument("--fresh", action="store_true", help="train all runs, including those in the store")
    slurm = parser.add_argument_group("for Slurm")
    slurm.add_argument(
        "--slurm",
        action="store_true",
        help="write the script of a job that starts a Ray cluster in its allocation and runs the sweep on it",
    )
    slurm.add_argument(
        "--array", action="store_true", help="write a job array instead: one job per seed, without Ray"
    )
    slurm.add_argument("--nodes", type=int, help="nodes of the allocation (default: 1)")
    slurm.add_argument("--cpus", type=int, help="CPUs per node (default: 1)")
    slurm.add_argument("--time", help="time limit, such as 12:00:00 (default: the partition's)")
    slurm.add_argument("--partition", help="partition (default: Slurm's default)")
    slurm.add_argument(
        "--sbatch",
        metavar="OPTION",
        action="append",
        help="further option of sbatch, such as --sbatch=--mem=8G; repeatable",
    )


def execute(arguments: argparse.Namespace) -> int:
    """Train, or write a script for Slurm; return the exit code."""
    if arguments.slurm:
        return _write_script(arguments)
    for name in ("array", *_ALLOCATION, "sbatch"):
        if getattr(arguments, name) not in (None, False):
            raise HeadwayError(f"--{name} needs --slurm")
    from headway_launch.experiments.notices import print_notices
    from headway_launch.experiments.sweep import compose_sweep
    from headway_launch.studies.plan import distinct
    from headway_launch.studies.session import StudySession

    experiments = distinct(compose_sweep(arguments.overrides))
    session = StudySession.plan(experiments, fresh=arguments.fresh)
    print_notices(arguments.overrides, experiments)
    if arguments.dry_run:
        from headway_launch.studies.dry_run import print_estimate

        return print_estimate(session.cells)
    _, code = session.train(arguments.debug, may_leave=True)
    return code


def _write_script(arguments: argparse.Namespace) -> int:
    from headway_launch.console.output import print_line
    from headway_launch.runner.cluster.slurm import Allocation, write_array_script, write_cluster_script

    if arguments.dry_run or arguments.fresh:
        raise HeadwayError("--slurm cannot be combined with --dry-run or --fresh")
    asked = {name: getattr(arguments, name) for name in _ALLOCATION}
    given = {name: value for name, value in asked.items() if value is not None}
    write = write_array_script if arguments.array else write_cluster_script
    path = write(arguments.overrides, Allocation(**given, further=tuple(arguments.sbatch or ())))
    print(path)
    print_line(f"submit it, and resubmit it to continue, with: sbatch {shlex.quote(str(path))}")
    return 0
