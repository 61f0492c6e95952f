"""What the cells of a study are called: by what was chosen and, where that is the same, how they were set."""

import ast
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from headway.config.experiment import NO_PRESET
from headway.store.index import RunRow
from headway.store.run_folder import RunRecord

_OF_TASK = "env."
_ARGS = "env.args."
_NOT_OF_TASK = "env.training_args."
"""What is learned from, not what is reported on."""
_WRAPPERS = "env.wrappers"
_POLICIES = "algo.policies"
"""Named by its value alone: `shared`."""
_MOST_NAMED = 6
"""Settings that a name has, all of them; of more it has the first."""
_FIRST_NAMED = 3


@dataclass(frozen=True, slots=True)
class CellChoice:
    """What makes a cell."""

    environment: str
    algorithm: str
    preset: str
    """Of hyper-parameters; empty where it is not known."""
    parameters: Mapping[str, str]
    """All its settings, by dotted names."""
    candidate: str = ""
    """Of a search; empty where it is of none."""


@dataclass(frozen=True, slots=True)
class CellName:
    """One cell among others. Different cells have different labels, and different pairs of the rest."""

    label: str
    """The controller and, where there are several tasks, the task: `mappo merge_paper on merge`."""
    task: str
    """The environment, with those of its arguments that differ: `bus, scenario=corridor`."""
    controller: str
    """The algorithm, with as much more as tells it apart on its task: the preset (`mappo merge_paper`) where
    presets differ, the candidate of a search (`mappo: own reward`), which policies (`ippo, shared`), settings
    (`ippo, algo.lr=0.001`)."""


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
    cells: dict[str, list[RunRow]] = defaultdict(list)
    for run in runs:
        cells[run.cell].append(run)
    return names_among({cell: _choice(of_cell) for cell, of_cell in cells.items()})


def names_among(cells: Mapping[str, CellChoice]) -> dict[str, CellName]:
    """What each of some cells is called among the others."""
    tasks = _told_apart({key: (cell.environment,) for key, cell in cells.items()}, cells, of_task=True)
    # A controller is told apart from those on its own task: other tasks may need other settings.
    kinds = {key: (cell.algorithm, tasks[key]) for key, cell in cells.items()}
    controllers = _told_apart(kinds, cells, of_task=False)
    several = len(set(tasks.values())) > 1
    return {
        key: CellName(
            f"{controllers[key]} on {tasks[key]}" if several else controllers[key],
            tasks[key],
            controllers[key],
        )
        for key in cells
    }


def _choice(runs: Sequence[RunRow]) -> CellChoice:
    """Of a cell, whose older runs may not know its preset or candidate: one record is read, the newest."""
    run = max(runs, key=lambda each: each.started)
    record = RunRecord.read(Path(run.directory))
    preset = next((each.preset for each in runs if each.preset), "")
    parameters = {**({_POLICIES: run.policies} if run.policies else {}), **record.parameters}
    return CellChoice(run.environment, run.algorithm, preset, parameters, record.candidate)


def _told_apart(
    kinds: Mapping[str, tuple[str, ...]], cells: Mapping[str, CellChoice], of_task: bool
) -> dict[str, str]:
    """Of each cell, the first of its `kinds` and what tells it apart from others of its kinds: the preset,
    the candidate of a search, then which policies, then the settings that are not the same in all that are
    still alike."""
    settings = {key: _parted(cell.parameters, of_task) for key, cell in cells.items()}
    alike: dict[tuple[str, ...], list[str]] = defaultdict(list)
    for key, kind in kinds.items():
        alike[kind].append(key)
    # What has several presets on one task is called by them on each.
    by_preset = {kind[0] for kind, keys in alike.items() if _presets_differ(keys, cells, settings)}
    by_candidate = set() if of_task else _of_several_candidates(kinds, cells)
    told: dict[str, str] = {}
    for kind, of_kind in alike.items():
        named: dict[str, list[str]] = defaultdict(list)
        for preset, of_preset in _by_preset(of_kind, cells, kind[0] in by_preset).items():
            for key in of_preset:
                candidate = f": {cells[key].candidate}" if kind[0] in by_candidate else ""
                named[f"{kind[0]}{preset}{candidate}"].append(key)
        for name, of_name in named.items():
            for policies, members in _by_policies(of_name, settings).items():
                own = _settings([settings[key] for key in members])
                told |= {
                    key: ", ".join((f"{name}{policies}", *differing))
                    for key, differing in zip(members, own, strict=True)
                }
    return told


def _of_several_candidates(kinds: Mapping[str, tuple[str, ...]], cells: Mapping[str, CellChoice]) -> set[str]:
    """The first of those kinds of which all cells, on all tasks, are candidates of a search, and several."""
    candidates: dict[str, set[str]] = defaultdict(set)
    for key, kind in kinds.items():
        candidates[kind[0]].add(cells[key].candidate)
    return {first for first, names in candidates.items() if len(names) > 1 and "" not in names}


def _presets_differ(
    keys: Sequence[str], cells: Mapping[str, CellChoice], settings: Mapping[str, Mapping[str, str]]
) -> bool:
    """Whether cells are of several presets: not where one is not known, or two set the same."""
    owners: dict[tuple[tuple[str, str], ...], set[str]] = defaultdict(set)
    for key in keys:
        owners[tuple(sorted(settings[key].items()))].add(cells[key].preset)
    presets = {cells[key].preset for key in keys}
    return "" not in presets and len(presets) > 1 and all(len(of_same) == 1 for of_same in owners.values())


def _by_preset(keys: Sequence[str], cells: Mapping[str, CellChoice], named: bool) -> dict[str, list[str]]:
    """The cells of each preset by what their names have of it, which is nothing unless `named`."""
    if not named:
        return {"": list(keys)}
    groups: dict[str, list[str]] = defaultdict(list)
    for key in keys:
        preset = cells[key].preset
        known = " without preset" if preset == NO_PRESET else f" {preset}"
        groups[known if preset else ""].append(key)
    return groups


def _by_policies(keys: Sequence[str], settings: Mapping[str, Mapping[str, str]]) -> dict[str, list[str]]:
    """The cells of each kind of policies by what their names have of it: nothing where it is the same."""
    groups: dict[str, list[str]] = defaultdict(list)
    for key in keys:
        groups[f", {settings[key].get(_POLICIES, 'without ' + _POLICIES)}"].append(key)
    return groups if len(groups) > 1 else {"": list(keys)}


def _settings(cells: Sequence[Mapping[str, str]]) -> list[Sequence[str]]:
    """Of each cell, `name=value` of the settings that are not the same in all; `without name` where it has
    none. Of many the first few are named, if that will do to tell the cells apart: cells of two presets, of
    which it is not known that they are, differ in a dozen."""
    whole = _differing(cells)
    short = [_first_few(own) for own in whole]
    return short if len(set(map(tuple, short))) == len(set(map(tuple, whole))) else list(whole)


def _first_few(settings: Sequence[str]) -> Sequence[str]:
    if len(settings) <= _MOST_NAMED:
        return settings
    return (*settings[:_FIRST_NAMED], f"{len(settings) - _FIRST_NAMED} settings more")


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
    """Of each cell, `name=value` of the parameters that are not the same in all, those of a task by the names
    that the environment has for them."""
    names = list(dict.fromkeys(name for cell in cells for name in cell))
    differing = {
        name: name.removeprefix(_ARGS) for name in names if len({cell.get(name) for cell in cells}) > 1
    }
    return [
        [
            f"{called}={cell[name]}" if name in cell else f"without {called}"
            for name, called in differing.items()
        ]
        for cell in cells
    ]
