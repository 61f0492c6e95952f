"""`headway plot`: learning curves of a study, as a picture."""

import argparse
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from headway.configuration import suggestion
from headway.contracts.errors import HeadwayError
from headway.store.naming import labelled_cells
from headway_launch.commands.runs import add_store_argument, existing_store
from headway_launch.study import finished_runs
from headway_launch.tables import shown

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from headway.store import RunRow

_FAR = 5.0
"""Times the range of all else: farther away a rule is not drawn, only named."""

EXAMPLES = """\
examples:
  headway plot bus
  headway plot bus --output curves.png --metric evaluation_sampled/return
  headway plot bus --low 0                         cut the vertical axis below 0

One line a cell (algorithm, policies, environment and the settings that tell cells apart): the mean
over its finished seeds with the 95% interval of that mean (Student's t); dashed lines beside a
metric of evaluation are the rules on the same days, but for one so far away that nothing else could be seen.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The study, the metric and the file."""
    parser.add_argument("study", metavar="STUDY", help="as `headway runs` shows it")
    parser.add_argument("--output", default=None, help="picture to write (default: STUDY.png)")
    parser.add_argument("--metric", default="evaluation_greedy/return", help="column of the curve")
    parser.add_argument("--low", type=float, default=None, help="lower end of the vertical axis")
    add_store_argument(parser)


def execute(arguments: argparse.Namespace) -> int:
    """Draw the picture and say where it is."""
    root = existing_store(arguments.store)
    runs = finished_runs(root, arguments.study)
    output = Path(arguments.output or f"{arguments.study}.png")
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(figsize=(10, 4.5), dpi=150, layout="constrained")
    for label, members in labelled_cells(runs).items():
        _draw_cell(axes, label, members, arguments.metric)
    _draw_rules(axes, root, arguments.study, arguments.metric, _days(runs[0]))
    if arguments.low is not None:
        axes.set_ylim(bottom=arguments.low)
    axes.set_xlabel("environment steps")
    axes.set_ylabel(arguments.metric.replace("_", " ").replace("/", ": "))
    axes.set_title(f"{arguments.study}: mean over seeds with 95% interval")
    axes.xaxis.set_major_formatter(lambda value, _: f"{value:,.0f}")
    axes.grid(alpha=0.3)
    figure.legend(fontsize="small", loc="outside right upper")
    try:
        figure.savefig(output)
    except (OSError, ValueError) as error:
        raise HeadwayError(f"--output: {output} cannot be written ({error})") from error
    print(output)
    return 0


def _curve(run: "RunRow", metric: str) -> Mapping[int, float]:
    from headway.store.log import read_curve, read_rows

    points = read_curve(Path(run.directory), metric)
    if not points:
        rows = read_rows(Path(run.directory), "curve")
        known = sorted({name for row in rows for name in row if "/" in name})
        raise HeadwayError(f"--metric: {run.run_id} has no {metric!r}; {suggestion(metric, known)}")
    return points


def _draw_cell(axes: "Axes", label: str, members: Sequence["RunRow"], metric: str) -> None:
    import numpy as np

    from headway.stats import mean_and_half_width

    curves = [_curve(run, metric) for run in members]
    steps = sorted(set.intersection(*(set(curve) for curve in curves)))
    if not steps:
        raise HeadwayError(f"the runs of {members[0].cell} share no evaluation points")
    values = np.array([[curve[step] for step in steps] for curve in curves])
    # A single seed has no interval.
    mean, half = mean_and_half_width(values) if len(values) > 1 else (values[0], np.zeros(len(steps)))
    seeds = f"{len(members)} seeds" if len(members) > 1 else "1 seed"
    (line,) = axes.plot(steps, mean, label=f"{label} ({seeds})")
    axes.fill_between(steps, mean - half, mean + half, color=line.get_color(), alpha=0.2, linewidth=0)


def _days(run: "RunRow") -> int:
    """Evaluation days of a curve's points: the last evaluation, and the rules, may have more."""
    import yaml

    config = yaml.safe_load((Path(run.directory) / "config.yaml").read_text(encoding="utf-8"))
    return int(config["evaluation"]["episodes"])


def _draw_rules(axes: "Axes", root: Path, study: str, metric: str, days: int) -> None:
    """A dashed line a rule, over the days of the curves, where the metric is an evaluation's: other curves
    are of other days, and perhaps of another reward."""
    from headway.store.folder import rules_files

    group, _, column = metric.rpartition("/")
    if not group.startswith("evaluation_"):
        return
    drawn: dict[str, float] = {}
    for path in rules_files(root, study):
        for rule, rows in json.loads(path.read_text()).items():
            same = [row[column] for row in rows if column in row and row["episode_seed"] < days]
            if same:
                drawn[rule] = sum(same) / len(same)
    near = _near(drawn, *axes.get_ylim())
    for place, (rule, value) in enumerate(sorted(drawn.items())):
        style: dict[str, Any] = {
            "linestyle": ("--", ":", "-.")[place % 3],
            "color": f"{0.2 + 0.1 * place:.2f}",
            "linewidth": 1,
        }
        if rule in near:
            axes.axhline(value, label=f"rule {rule}", **style)
        else:
            axes.plot([], [], label=f"rule {rule} (off, at {shown(value)})", **style)


def _near(rules: Mapping[str, float], low: float, high: float) -> set[str]:
    """The rules that may stretch an axis from `low` to `high`: the nearest, and each next one that is not
    farther off than some times the range so far. One that fails (buses at random) would flatten the rest."""

    def distance(rule: str) -> float:
        return max(low - rules[rule], rules[rule] - high, 0.0)

    near: set[str] = set()
    for rule in sorted(rules, key=distance):
        if near and distance(rule) > _FAR * (high - low):
            break
        near.add(rule)
        low, high = min(low, rules[rule]), max(high, rules[rule])
    return near
