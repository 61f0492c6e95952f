"""`headway plot`: plot a study's learning curves."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from headway.wording import readable_metric
from headway_launch.commands.arguments import add_store_argument, add_where_argument, existing_store
from headway_launch.console.output_files import write_figure

if TYPE_CHECKING:
    import pandas as pd

EXAMPLES = """\
examples:
  headway plot bus
  headway plot bus --output curves.png --metric evaluation_sampled/return
  headway plot bus --low 0                         start the vertical axis at 0
  headway plot bus --metric mean_wait_min --lower-is-better
  headway plot bus --where 'policies=shared and algo.lr<1e-3' --no-rules

One line per cell (algorithm and, if needed to distinguish cells, preset, search candidate and settings) and
one panel per environment: mean over finished seeds with the 95% interval of the mean (Student's t), if there
are at least three. Dashed lines show the rules on the same episodes, for evaluation metrics. Rules so far off
that they would flatten the curves are omitted, and the axis is not extended for cells far worse than most.
The steps in which a rule acts and policies learn to imitate it (start.rule) are shaded. Training curves
whose seeds have points at different steps are interpolated linearly.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the study, the metric and the file."""
    parser.add_argument("study", metavar="STUDY", help="name of the study, as in `headway runs`")
    parser.add_argument("-o", "--output", default=None, help="picture to write (default: STUDY.png)")
    parser.add_argument(
        "--metric",
        default="evaluation_greedy/return",
        help="column of the curve; a name without group is of evaluation_greedy (default: return)",
    )
    add_where_argument(parser)
    parser.add_argument("--no-rules", action="store_true", help="omit the rules")
    parser.add_argument(
        "--lower-is-better", action="store_true", help="the metric is a cost, such as a waiting time"
    )
    parser.add_argument("--low", type=float, default=None, help="lower end of the vertical axis")
    add_store_argument(parser)


def execute(arguments: argparse.Namespace) -> int:
    """Plot, and print the path of the picture."""
    from headway.stats import frames, plots
    from headway_launch.studies.runs import (
        curve_column,
        curves_of,
        finished_runs,
        metric_descriptions,
        rule_phases,
        rules_beside,
    )

    root = existing_store(arguments.store)
    metric = curve_column(arguments.metric)
    runs = finished_runs(root, arguments.study, arguments.where)
    output = Path(arguments.output or f"{arguments.study}.png")
    means = frames.mean_curves(curves_of(runs, metric))
    remark = " (lower is better)" if arguments.lower_is_better else ""
    group, _, column = metric.rpartition("/")
    name = readable_metric(column, metric_descriptions(runs).get(column, ""))
    label = f"{group.removeprefix('evaluation_')}: {name}{remark}"
    figure = plots.learning_curves(
        means,
        {} if arguments.no_rules else rules_beside(runs, metric),
        label,
        plots.colours(list(dict.fromkeys(means["controller"]))),
        low=arguments.low,
        title=f"{arguments.study}: {_statistic(means)}",
        sign=-1 if arguments.lower_is_better else 1,
        rule_phases=rule_phases(runs),
    )
    write_figure(figure, output)
    print(output)
    return 0


def _statistic(means: "pd.DataFrame") -> str:
    """Name the plotted statistic, which is without an interval for cells with few runs."""
    from headway.stats.plots import FEWEST_SEEDS

    runs = means["runs"]
    if (runs == 1).all():
        return "one seed"
    if (runs < FEWEST_SEEDS).all():
        return "mean over seeds"
    few = f" of at least {FEWEST_SEEDS}" if (runs < FEWEST_SEEDS).any() else ""
    return f"mean over seeds with 95% interval{few}"
