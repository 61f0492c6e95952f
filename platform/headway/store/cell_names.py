"""Short names for the cells of a study, built from the choices and settings in which the cells differ."""

import ast
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from headway.config.experiment import NO_PRESET
from headway.contracts.errors import HeadwayError
from headway.store.index import RunRow
from headway.store.run_folder import RunRecord
from headway.wording import environment_name

_Item = TypeVar("_Item")
_Key = TypeVar("_Key", bound=Hashable)
_TASK_PREFIX = "env."
_ARGS = "env.args."
_TRAINING_ARGS = "env.training_args."
"""Arguments of the training environment only; results are reported on the evaluation environment."""
_WRAPPERS = "env.wrappers"
_POLICIES = "algo.policies"
"""Shown without its key, as `shared`."""
_MAX_SHOWN = 6
"""Maximum number of settings shown in full; a longer list is cut to the first `_FIRST_SHOWN`."""
_FIRST_SHOWN = 3
_MAX_LENGTH = 100
"""Maximum length of a value that is shown where the other cells have none."""


@dataclass(frozen=True, slots=True)
class CellChoice:
    """The choices and settings that define a cell."""

    environment: str
    algorithm: str
    preset: str
    """Hyper-parameter preset; empty if unknown."""
    parameters: Mapping[str, str]
    """All settings by dotted name."""
    candidate: str = ""
    """Name of the search candidate; empty if the cell is not part of a search."""
    study: str = ""
    """Name of the study; empty if it does not matter."""


@dataclass(frozen=True, slots=True)
class CellName:
    """Name of one cell among others. Labels are unique, and so are the pairs of task and controller."""

    label: str
    """The controller and, if there are several tasks, the task: `mappo merge_paper on merge`."""
    task: str
    """The environment and those of its arguments that differ between cells: `bus, scenario=corridor`."""
    controller: str
    """The algorithm and whatever else makes it unique on its task: the study, if several have the algorithm
    (`started: mappo`), the preset (`mappo merge_paper`), the search candidate (`mappo: own reward`), the
    policies (`ippo, shared`) and settings (`ippo, algo.lr=0.001`)."""


def labelled_cells(runs: Iterable[RunRow], beside: Iterable[RunRow] = ()) -> dict[str, list[RunRow]]:
    """Return the runs of each cell by its label, sorted by label; errors and `beside` as in `cell_names`."""
    rows = list(runs)
    names = cell_names(rows, beside)
    return dict(sorted(_grouped(rows, lambda row: names[row.cell].label).items()))


def cell_names(runs: Iterable[RunRow], beside: Iterable[RunRow] = ()) -> dict[str, CellName]:
    """Return the name of each cell, by its key in the store.

    `beside`: further runs, from whose cells the names distinguish the others too, such as those that a sweep
    has not finished. Raises HeadwayError if the record of one of `runs` cannot be read.
    """
    choices = {cell: _choice(members) for cell, members in _grouped(runs, lambda run: run.cell).items()}
    for cell, members in _grouped(beside, lambda run: run.cell).items():
        if cell not in choices:
            with suppress(HeadwayError):
                choices[cell] = _choice(members)
    return names_among(choices)


def _grouped(items: Iterable[_Item], by: Callable[[_Item], _Key]) -> dict[_Key, list[_Item]]:
    groups: dict[_Key, list[_Item]] = {}
    for item in items:
        groups.setdefault(by(item), []).append(item)
    return groups


def varied_settings(runs: Sequence[RunRow]) -> tuple[list[str], dict[str, Mapping[str, str]]]:
    """Return the names of the settings that a sweep varied, and all settings of each cell by its key.

    A setting is varied if it differs between cells of one study, environment, algorithm and preset. Choices
    that are fields of a run, such as `algo.policies`, are left out, and so are cells whose record cannot be
    read.
    """
    settings: dict[str, Mapping[str, str]] = {}
    for cell, members in _grouped(runs, lambda run: run.cell).items():
        with suppress(HeadwayError):
            settings[cell] = _choice(members).parameters
    known = [run for run in runs if run.cell in settings]
    alike = _grouped(known, lambda run: (run.study, run.environment, run.algorithm, run.preset))
    varied: dict[str, None] = {}
    for members in alike.values():
        keys = sorted({run.cell for run in members})
        names = {name: None for key in keys for name in settings[key]}
        varied |= {name: None for name in names if len({settings[key].get(name) for key in keys}) > 1}
    return [name for name in varied if "." in name and name != _POLICIES], settings


def names_among(cells: Mapping[str, CellChoice]) -> dict[str, CellName]:
    """Return a name for each cell that is unique among `cells` and as short as possible."""
    kinds = {key: (environment_name(cell.environment),) for key, cell in cells.items()}
    tasks = _unique_names(kinds, cells, of_task=True)
    # Controllers are compared within their own task: other tasks may need other settings.
    pairs = {key: (cell.algorithm, tasks[key]) for key, cell in cells.items()}
    # An algorithm that needs its study in the name on one task shows it on all tasks.
    by_study = {
        pair[0]
        for pair, keys in _grouped(pairs, lambda key: pairs[key]).items()
        if len({cells[key].study for key in keys}) > 1
    }
    named = {
        key: (f"{cells[key].study}: {name}" if name in by_study else name, task)
        for key, (name, task) in pairs.items()
    }
    controllers = _unique_names(named, cells, of_task=False)
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
    """Return the choices and settings of the cell of `runs`, read from its newest run's record."""
    from headway.registry import hashed_parameters

    # Older runs may have been stored without the preset or the candidate.
    run = max(runs, key=lambda each: each.started)
    record = RunRecord.read(Path(run.directory))
    preset = next((each.preset for each in runs if each.preset), "")
    policies = {_POLICIES: run.policies} if run.policies else {}
    parameters = {**policies, **hashed_parameters(run.algorithm, record.parameters)}
    studies = " and ".join(sorted({each.study for each in runs}))
    return CellChoice(run.environment, run.algorithm, preset, parameters, record.candidate, studies)


def _unique_names(
    kinds: Mapping[str, tuple[str, ...]], cells: Mapping[str, CellChoice], of_task: bool
) -> dict[str, str]:
    """Return a unique name per cell, given the kind of each.

    The name consists of the first item of its kind, then the preset, search candidate, policies and settings
    that differ between the cells of that kind. `of_task`: compare the settings of the task; else those of the
    controller.
    """
    settings = {key: _settings_of(cell.parameters, of_task) for key, cell in cells.items()}
    groups = _grouped(kinds, lambda key: kinds[key])
    # An algorithm that needs its preset in the name on one task shows it on all tasks.
    by_preset = {kind[0] for kind, keys in groups.items() if _presets_differ(keys, cells, settings)}
    by_candidate = set() if of_task else _with_candidates(kinds, cells)

    def chosen(key: str) -> str:
        name, cell = kinds[key][0], cells[key]
        preset = " without preset" if cell.preset == NO_PRESET else f" {cell.preset}".rstrip()
        candidate = f": {cell.candidate}" if name in by_candidate else ""
        return f"{name}{preset if name in by_preset else ''}{candidate}"

    def policies(key: str) -> str:
        return f", {settings[key].get(_POLICIES, 'without ' + _POLICIES)}"

    names: dict[str, str] = {}
    for of_kind in groups.values():
        for name, keys in _grouped(of_kind, chosen).items():
            by_policies = _grouped(keys, policies)
            for shared, members in by_policies.items() if len(by_policies) > 1 else [("", keys)]:
                own = _shown_settings([settings[key] for key in members])
                names |= {
                    key: ", ".join((f"{name}{shared}", *differing))
                    for key, differing in zip(members, own, strict=True)
                }
    return names


def _with_candidates(kinds: Mapping[str, tuple[str, ...]], cells: Mapping[str, CellChoice]) -> set[str]:
    """Return the algorithms whose cells, on all tasks, belong to at least two candidates of a search."""
    by_name = _grouped(kinds, lambda key: kinds[key][0])
    candidates = {name: {cells[key].candidate for key in keys} for name, keys in by_name.items()}
    return {name for name, found in candidates.items() if len(found) > 1 and "" not in found}


def _presets_differ(
    keys: Sequence[str], cells: Mapping[str, CellChoice], settings: Mapping[str, Mapping[str, str]]
) -> bool:
    """Return whether the presets are all known, at least two, and no two of them have the same settings."""
    alike = _grouped(keys, lambda key: tuple(sorted(settings[key].items())))
    presets = {cells[key].preset for key in keys}
    owners = [{cells[key].preset for key in members} for members in alike.values()]
    return "" not in presets and len(presets) > 1 and all(len(names) == 1 for names in owners)


def _shown_settings(cells: Sequence[Mapping[str, str]]) -> list[Sequence[str]]:
    """Return the settings that differ between the cells, per cell: `name=value`, or `without name`.

    A long list is cut if the cells stay distinct.
    """
    # Cells of two presets that were stored without the preset's name differ in a dozen settings.
    full = _differing(cells)
    short = [_first_few(own) for own in full]
    return short if len(set(map(tuple, short))) == len(set(map(tuple, full))) else list(full)


def _first_few(settings: Sequence[str]) -> Sequence[str]:
    if len(settings) <= _MAX_SHOWN:
        return settings
    return (*settings[:_FIRST_SHOWN], f"{len(settings) - _FIRST_SHOWN} settings more")


def _settings_of(parameters: Mapping[str, str], of_task: bool) -> dict[str, str]:
    """Return the parameters that define the cell's task, or those that define its controller."""
    settings = {
        name: value
        for name, value in parameters.items()
        if (name.startswith(_TASK_PREFIX) and not name.startswith(_TRAINING_ARGS)) is of_task
    }
    settings.pop(_WRAPPERS, None)
    if wrappers := _wrappers(parameters.get(_WRAPPERS, "[]"), of_task):
        settings[_WRAPPERS] = wrappers
    return settings


def _wrappers(text: str, of_task: bool) -> str:
    """Return the wrappers that define the task or, if not `of_task`, those that only change rewards.

    The latter belong to the controller. Empty if there are none.
    """
    from headway.registry import wrapper_entry

    # Parsed but not evaluated: an argument may be infinite, and `inf` is no Python literal.
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
    """Return the parameters that differ between the cells, per cell, as `name=value` or `without name`; the
    only value of a name as `with name` if it is long.

    Environment arguments are shown without their prefix.
    """
    names = list(dict.fromkeys(name for cell in cells for name in cell))
    values = {name: {cell.get(name) for cell in cells} for name in names}
    differing = {name: name.removeprefix(_ARGS) for name in names if len(values[name]) > 1}

    def shown(name: str, cell: Mapping[str, str]) -> str:
        if name not in cell:
            return f"without {differing[name]}"
        if len(values[name]) == 2 and None in values[name] and len(cell[name]) > _MAX_LENGTH:
            return f"with {differing[name]}"
        return f"{differing[name]}={cell[name]}"

    return [[shown(name, cell) for name in differing] for cell in cells]
