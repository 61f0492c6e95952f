"""One experiment in a YAML file at any path: `headway run FILE.yaml`."""

import hashlib
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from headway.config.experiment import NO_PRESET
from headway.config.schema import suggestion
from headway.contracts.errors import HeadwayError
from headway.registry import is_external
from headway.store.run_configuration import upgraded
from headway_launch.experiments.options import options
from headway_launch.experiments.yaml_file import read_mapping

_GROUP = "experiment"
_NAMED_BY = {"env": "id", "algo": "name", "backend": "name"}
"""By group: key that holds the chosen option in a stored configuration."""
_WITH_PATHS = ("env", "stages")
"""Keys under which a value may be the path of an environment's file or data."""


def split_experiment_file(overrides: Sequence[str]) -> tuple[Path | None, list[str]]:
    """Return the experiment's file among the overrides, or None, and the remaining overrides.

    Raises HeadwayError for a second experiment.
    """
    endings = (".yaml", ".yml")
    files = [
        word for word in overrides if word.endswith(endings) and ("=" not in word or Path(word).is_file())
    ]
    others = [word for word in overrides if word not in files]
    second = [word for word in others if word.startswith(f"{_GROUP}=")]
    if len(named := dict.fromkeys([*files, *second])) > 1:
        raise HeadwayError(f"{' and '.join(named)} are several experiments; give one")
    return (Path(files[0]) if files else None), others


def choice_of_file(path: Path) -> str:
    """Make the experiment in a file known to Hydra; return the override that chooses it.

    A group's option may be given as `algo: mappo`, without Hydra's list of defaults. If the file is the
    stored configuration of a run, missing keys have the values that the run had. Relative paths that do not
    exist in the current folder are those beside the file. Raises HeadwayError for a file that cannot be used.
    """
    content = _content(path)
    for key in _WITH_PATHS:
        if key in content:
            content[key] = _beside(path.parent, content[key])
    if path.name == "config.yaml" and path.with_name("run.json").is_file():
        content = {**upgraded(content), "preset": NO_PRESET}  # its values are written out
        if isinstance(env := content.get("env"), dict):
            content["env"] = {key: value for key, value in env.items() if key != "file_digest"}
    if dotted := next((key for key in content if "." in key), None):
        group, *rest = dotted.split(".")
        name = f"{_NAMED_BY[group]}: NAME, " if group in _NAMED_BY else ""
        nested = ": {".join(rest) + ": VALUE" + "}" * (len(rest) - 1)
        raise HeadwayError(f"{path}: {dotted}: keys of a file are nested; write {group}: {{{name}{nested}}}")
    defaults = content.pop("defaults", None) or []
    if not isinstance(defaults, list):
        raise HeadwayError(f"{path}: defaults must be a list, such as [override /algo: mappo]")
    for group, known in options().items():
        if group in (_GROUP, "search", "space") or group not in content:
            continue
        value = content[group]
        if value is False and "off" in known:
            value = "off"  # YAML reads the bare word so
        named_by = _NAMED_BY.get(group, "")
        chosen = value.get(named_by) if isinstance(value, dict) else value
        external = group == "env" and isinstance(chosen, str) and is_external(chosen)
        if isinstance(value, list):
            several = f"`headway sweep {path} {group}={','.join(map(str, value))}`"
            raise HeadwayError(
                f"{path}: {group} takes one name; write {group}: NAME, and {several} trains several"
            )
        if isinstance(value, str):
            del content[group]
            if not external and chosen not in known:
                raise HeadwayError(unknown_option(path, group, value, known))
        elif isinstance(value, dict) and (external or chosen in known):
            content[group] = {key: inner for key, inner in value.items() if key != named_by}
        else:
            continue
        if external:  # an option too, so that env=NAME on the command line chooses another
            chosen = _stored("env", {"id": chosen})
        defaults.append({f"override /{group}": chosen})
    return f"{_GROUP}={_stored(_GROUP, {'defaults': defaults, **content}, package='_global_')}"


def _stored(group: str, node: Mapping[str, Any], **keywords: str) -> str:
    """Store a configuration as an option of a group for Hydra; return the option's name."""
    from hydra.core.config_store import ConfigStore

    name = f"file_{hashlib.sha256(repr(node).encode()).hexdigest()[:16]}"
    ConfigStore.instance().store(name, node, group, **keywords)
    return name


def _beside(folder: Path, value: object) -> object:
    """Return a value with its relative paths that exist in `folder`, and not in the current one, absolute.

    A word with neither `/` nor `.` is not taken for a path, since it may be the name of packaged data, such
    as a scenario.
    """
    if isinstance(value, dict):
        return {key: _beside(folder, inner) for key, inner in value.items()}
    if isinstance(value, list):
        return [_beside(folder, inner) for inner in value]
    with suppress(OSError):  # no path, such as a text that is too long
        if isinstance(value, str) and {"/", "."} & set(value) and not Path(value).exists():
            there = folder / value
            return str(there.resolve()) if there.exists() else value
    return value


def unknown_option(file: Path | None, group: str, option: str, known: Sequence[str]) -> str:
    """Return an error line about an option that no file of its group has; `file`: the experiment's."""
    folder = file.parent.parent if file else Path()
    there = bool(file) and (folder / group / f"{option}.yaml").is_file()
    hint = f"--config-dir {folder} would know it" if there else suggestion(option, known)
    return f"{f'{file}: ' if file else ''}there is no {group} {option!r}; {hint}"


def _content(path: Path) -> dict[str, Any]:
    if not path.is_file():
        raise HeadwayError(
            f"{path}: there is no such file; give an experiment's YAML file, or experiment=NAME"
        )
    content = read_mapping(path)
    if not content:
        raise HeadwayError(f"{path} must hold keys of an experiment, such as env: bus (`headway list keys`)")
    if "hydra" in content:
        raise HeadwayError(f"{path}: hydra is not a key of an experiment; remove it")
    return content
