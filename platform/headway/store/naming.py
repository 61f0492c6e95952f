"""What the cells of a study are called: what they are and, where that is the same, how they were set."""

import ast
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from headway.store.folder import RunRecord
from headway.store.index import RunRow

_OF_TASK = "env."
_NOT_OF_TASK = "env.training_args."
"""What is learned from, not what is reported on."""
_WRAPPERS = "env.wrappers"
_MOST_NAMED = 6
"""Settings that a name has, all of them; of more it has the first."""
_FIRST_NAMED = 3


@dataclass(frozen=True, slots=True)
class CellName:
    """One cell among others. Different cells have different labels, and different pairs of the rest."""

    label: str
    """`ippo, shared, bus, algo.lr 0.001`."""
    task: str
    """The environment, with those of its arguments that differ: `bus, env.args.scenario corridor`."""
    controller: str
    """The algorithm, with those of its settings that differ: `ippo, shared, algo.lr 0.001`."""


def labelled_cells(runs: Iterable[RunRow]) -> dict[str, list[RunRow]]:
    """The runs of each cell by its label. Labels are in order. Raises HeadwayError for a run whose record
    cannot be read."""
    rows = list(runs)
    names = cell_names(rows)
    cells: dict[str, list[RunRow]] = defaultdict(list)
    for row in rows:
        cells[names[row.cell].label].append(row)
    return dict(sorted(cells.items()))


def cell_names(runs: Iterable[RunRow]) -> dict[str, CellName]:
    """What each cell is called. Raises HeadwayError for a run whose record cannot be read."""
    first: dict[str, RunRow] = {}
    for run in runs:
        first.setdefault(run.cell, run)
    parameters = {cell: RunRecord.read(Path(run.directory)).parameters for cell, run in first.items()}
    of_task = {cell: _parted(every, of_task=True) for cell, every in parameters.items()}
    of_controller = {cell: _parted(every, of_task=False) for cell, every in parameters.items()}
    labels = told_apart(
        {cell: (f"{run.algorithm}, {run.policies}, {run.environment}",) for cell, run in first.items()},
        parameters,
    )
    tasks = told_apart({cell: (run.environment,) for cell, run in first.items()}, of_task)
    # A controller is told apart from those on its own task only: other tasks may need other settings.
    controllers = told_apart({cell: (_kind(run), tasks[cell]) for cell, run in first.items()}, of_controller)
    return {cell: CellName(labels[cell], tasks[cell], controllers[cell]) for cell in first}


def told_apart(
    kinds: Mapping[str, tuple[str, ...]], parameters: Mapping[str, Mapping[str, str]]
) -> dict[str, str]:
    """Of each cell, the first of its `kinds` and, `name value`, the parameters that are not the same in all
    cells of its kinds; `without name` where it has none. Of many the first few are named, if that will do to
    tell the cells apart: settings of two presets differ in a dozen."""
    alike: dict[tuple[str, ...], list[str]] = defaultdict(list)
    for cell, kind in kinds.items():
        alike[kind].append(cell)
    told: dict[str, str] = {}
    for kind, cells in alike.items():
        settings = _differing([parameters[cell] for cell in cells])
        names = [", ".join((kind[0], *own)) for own in settings]
        short = [", ".join((kind[0], *_first_few(own))) for own in settings]
        told |= dict(zip(cells, short if len(set(short)) == len(set(names)) else names, strict=True))
    return told


def _first_few(settings: Sequence[str]) -> Sequence[str]:
    if len(settings) <= _MOST_NAMED:
        return settings
    return (*settings[:_FIRST_NAMED], f"{len(settings) - _FIRST_NAMED} settings more")


def _kind(run: RunRow) -> str:
    return f"{run.algorithm}, {run.policies}" if run.policies else run.algorithm


def _parted(parameters: Mapping[str, str], of_task: bool) -> dict[str, str]:
    """The parameters of a cell that say what it is reported on, or the others."""

    def says_what(name: str) -> bool:
        return name.startswith(_OF_TASK) and not name.startswith(_NOT_OF_TASK)

    parted = {name: value for name, value in parameters.items() if says_what(name) is of_task}
    parted.pop(_WRAPPERS, None)
    if wrappers := _wrappers(parameters.get(_WRAPPERS, "[]"), of_task):
        parted[_WRAPPERS] = wrappers
    return parted


def _wrappers(text: str, of_task: bool) -> str:
    """Wrappers that only change rewards are there while learning only. Empty where there are none."""
    from headway.registry import wrapper_entry

    # Not evaluated: an argument may be infinite, and `inf` is no literal.
    listed = ast.parse(text, mode="eval").body
    assert isinstance(listed, ast.List)
    kept = [each for each in listed.elts if wrapper_entry(_name(each)).only_rewards is not of_task]
    return f"[{', '.join(ast.unparse(each) for each in kept)}]" if kept else ""


def _name(wrapper: ast.expr) -> str:
    assert isinstance(wrapper, ast.Dict)
    items = zip(wrapper.keys, wrapper.values, strict=True)
    named = {key.value: value for key, value in items if isinstance(key, ast.Constant)}
    return str(ast.literal_eval(named["name"]))


def _differing(cells: Sequence[Mapping[str, str]]) -> list[list[str]]:
    """Of each cell, `name value` of the parameters that are not the same in all."""
    names = list(dict.fromkeys(name for cell in cells for name in cell))
    differing = [name for name in names if len({cell.get(name) for cell in cells}) > 1]
    return [
        [f"{name} {cell[name]}" if name in cell else f"without {name}" for name in differing]
        for cell in cells
    ]
