"""`headway sweep`: train every combination of values and seeds, as far as the store does not have them."""

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from headway_launch.study_plan import Standing

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
    parser.add_argument(
        "--dry-run", action="store_true", help="list the runs and estimate time and energy; trains nothing"
    )
    parser.add_argument("--fresh", action="store_true", help="train anew what the store has, too")


def execute(arguments: argparse.Namespace) -> int:
    """Train; returns the exit code."""
    from headway_launch.threads import limit_threads

    limit_threads()
    from headway.store.index import RunIndex
    from headway_launch.conducting import Conductor
    from headway_launch.study_plan import Standing, distinct, keep_plan, plan_cells
    from headway_launch.sweeping import compose_sweep
    from headway_launch.telling import tell

    experiments = distinct(compose_sweep(arguments.overrides))
    config = experiments[0].config
    root = Path(config.store.root)
    index = RunIndex(root)
    rows = index.rows(config.study)
    for notice in index.notices:
        tell(f"headway: {notice}")
    if arguments.fresh:
        standings = [Standing.untouched(experiment) for experiment in experiments]
    else:
        standings = [Standing.of(root, experiment, rows) for experiment in experiments]
    cells = plan_cells(standings)
    if arguments.dry_run:
        from headway_launch.estimating import print_estimate

        return print_estimate(standings, cells)
    conductor = Conductor(cells, arguments.debug, plan_kept=True)
    keep_plan(root, config.study, experiments)
    tell_standing(config.study, standings)
    return conductor.conduct()


def tell_standing(study: str, standings: Sequence["Standing"]) -> None:
    """A line on what the store has already; nothing where that is nothing."""
    from headway_launch.telling import tell

    counts = {
        "have finished and are left alone": sum(len(standing.finished) for standing in standings),
        "go on": sum(len(standing.unfinished) for standing in standings),
        "are left to the session that trains them": sum(len(standing.elsewhere) for standing in standings),
        "begin": sum(len(standing.new) for standing in standings),
    }
    if any(counts[kind] for kind in list(counts)[:3]):
        parts = ", ".join(f"{count} {kind}" for kind, count in counts.items() if count)
        tell(f"headway: of {sum(counts.values())} runs of study {study}, {parts}")
