"""`headway plot`: learning curves of a study, as a picture."""

import argparse
import json
from collections import defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from headway.config import StoreConfig
from headway.configuration import suggestion
from headway.contracts.errors import HeadwayError
from headway_launch.commands.runs import existing_store

if TYPE_CHECKING:
    import numpy as np
    from matplotlib.axes import Axes
    from numpy.typing import NDArray

    from headway.store import RunRow

EXAMPLES = """\
examples:
  headway plot bus
  headway plot bus --output curves.png --metric evaluation_sampled/return
  headway plot bus --low 0                         cut the vertical axis below 0

One line a cell (algorithm, policies and other settings that differ): the mean over its finished seeds
with the 95% interval of that mean (Student's t); dashed lines are the rules on the same days.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The study, the metric and the file."""
    parser.add_argument("study", metavar="STUDY", help="as `headway runs` shows it")
    parser.add_argument("--output", default=None, help="picture to write (default: STUDY.png)")
    parser.add_argument("--metric", default="evaluation_greedy/return", help="column of the curve")
    parser.add_argument("--low", type=float, default=None, help="lower end of the vertical axis")
    parser.add_argument("--store", default=StoreConfig().root, help="folder of the store (default: runs)")


def execute(arguments: argparse.Namespace) -> int:
    """Draw the picture and say where it is."""
    root = existing_store(arguments.store)
    runs = _finished(root, arguments.study)
    output = Path(arguments.output or f"{arguments.study}.png")
    cells: dict[str, list[RunRow]] = defaultdict(list)
    for run in runs:
        cells[_cell(run)].append(run)
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(figsize=(8, 4.5), dpi=150, layout="constrained")
    for name, members in sorted(cells.items(), key=lambda item: _label(item[1])):
        _draw_cell(axes, _label(members), members, arguments.metric, name)
    _draw_rules(axes, root, arguments.study, arguments.metric)
    if arguments.low is not None:
        axes.set_ylim(bottom=arguments.low)
    axes.set_xlabel("environment steps")
    axes.set_ylabel(arguments.metric.replace("_", " ").replace("/", ": "))
    axes.set_title(f"{arguments.study}: mean over seeds with 95% interval")
    axes.xaxis.set_major_formatter(lambda value, _: f"{value:,.0f}")
    axes.grid(alpha=0.3)
    axes.legend(fontsize="small", loc="lower right")
    try:
        figure.savefig(output)
    except (OSError, ValueError) as error:
        raise HeadwayError(f"--output: {output} cannot be written ({error})") from error
    print(output)
    return 0


def _finished(root: Path, study: str) -> list["RunRow"]:
    from headway.store import RunIndex

    rows = RunIndex(root).rows()
    studies = sorted({row.study for row in rows})
    if study not in studies:
        raise HeadwayError(f"there is no study {study!r} in {root}; {suggestion(study, studies)}")
    finished = [row for row in rows if row.study == study and row.status == "FINISHED"]
    if not finished:
        raise HeadwayError(f"study {study!r} has no finished run to plot; see headway runs --study {study}")
    return finished


def _cell(run: "RunRow") -> str:
    return run.run_id.rsplit("-s", 1)[0]


def _label(members: Sequence["RunRow"]) -> str:
    first = members[0]
    return f"{first.algorithm}, {first.policies}, {first.environment}"


def _curve(run: "RunRow", metric: str) -> Mapping[int, float]:
    from headway.store.log import read_rows

    rows = read_rows(Path(run.directory), "curve")
    points = {int(row["env_steps"]): float(row[metric]) for row in rows if metric in row}
    if not points:
        known = sorted({name for row in rows for name in row if "/" in name})
        raise HeadwayError(f"--metric: {run.run_id} has no {metric!r}; {suggestion(metric, known)}")
    return points


def _draw_cell(axes: "Axes", label: str, members: Sequence["RunRow"], metric: str, name: str) -> None:
    import numpy as np

    curves = [_curve(run, metric) for run in members]
    steps = sorted(set.intersection(*(set(curve) for curve in curves)))
    if not steps:
        raise HeadwayError(f"the runs of {name} share no evaluation points")
    values = np.array([[curve[step] for step in steps] for curve in curves])
    mean, half = _interval(values)
    seeds = f"{len(members)} seeds" if len(members) > 1 else "1 seed"
    (line,) = axes.plot(steps, mean, label=f"{label} ({seeds})")
    axes.fill_between(steps, mean - half, mean + half, color=line.get_color(), alpha=0.2, linewidth=0)


def _interval(values: "NDArray[np.float64]") -> tuple["NDArray[np.float64]", "NDArray[np.float64]"]:
    """Mean and half width of its 95% interval over axis 0; no width for a single seed."""
    import numpy as np
    from scipy import stats

    count = len(values)
    mean = values.mean(axis=0)
    if count < 2:
        return mean, np.zeros_like(mean)
    return mean, stats.t.ppf(0.975, count - 1) * values.std(axis=0, ddof=1) / np.sqrt(count)


def _draw_rules(axes: "Axes", root: Path, study: str, metric: str) -> None:
    """A dashed line a rule, where the metric is one of an episode's columns."""
    from headway.store.folder import rules_files

    column = metric.rsplit("/", 1)[-1]
    drawn: dict[str, float] = {}
    for path in rules_files(root, study):
        for rule, rows in json.loads(path.read_text()).items():
            if rows and column in rows[0]:
                drawn[rule] = sum(row[column] for row in rows) / len(rows)
    for place, (rule, value) in enumerate(sorted(drawn.items())):
        axes.axhline(value, linestyle=("--", ":", "-.")[place % 3], color=f"{0.2 + 0.1 * place:.2f}",
                     linewidth=1, label=f"rule {rule}")  # fmt: skip
