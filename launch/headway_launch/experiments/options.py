"""Options of each group of an experiment: files of `configs`, and registered names, which need no file."""

import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from itertools import dropwhile, takewhile
from pathlib import Path
from typing import Any

from headway.config.experiment import BackendConfig
from headway.config.schema import literal_choices
from headway.contracts.errors import HeadwayError
from headway.registry import algo_entries, env_entries

NO_ENV = "none"
"""The option of the group `env` that applies if none is chosen."""
_OWN_FOLDER: ContextVar[Path | None] = ContextVar("own_folder", default=None)
_SENTENCE = re.compile(r".*?\.(?=\s|$)")


def configs_folder() -> Path:
    """Return the folder `configs` of the project, or its copy in an installed package.

    Raises HeadwayError if there is neither.
    """
    in_project = Path(__file__).resolve().parents[3] / "configs"
    packaged = Path(__file__).resolve().parents[1] / "packaged_configs"
    for folder in (in_project, packaged):
        if (folder / "config.yaml").is_file():
            return folder
    raise HeadwayError(f"there are no configurations in {in_project}; reinstall headway")


@contextmanager
def own_configs(folder: str) -> Iterator[None]:
    """Also find the options in `folder`, which has the same groups as `configs`: experiment/, preset/ and so
    on.

    Raises HeadwayError if `folder` has none of these groups, or a file that the project also has.
    """
    path = Path(folder).resolve()
    if not path.is_dir():
        raise HeadwayError(f"--config-dir {folder}: there is no such folder; correct the path")
    project = _files(configs_folder())
    groups = sorted({*_REGISTERED, *project})
    own = {group: names for group, names in _files(path).items() if group in groups}
    if not any(own.values()):
        raise HeadwayError(
            f"--config-dir {folder} has no YAML files in a folder of one of the names {', '.join(groups)}"
        )
    for group, names in own.items():
        if taken := names & project.get(group, set()):
            raise HeadwayError(
                f"{path / group / min(taken)}.yaml: Headway's own {group} has this name; choose another"
            )
    token = _OWN_FOLDER.set(path)
    try:
        yield
    finally:
        _OWN_FOLDER.reset(token)


def own_folder() -> Path | None:
    """Return the folder given to `own_configs`; None outside that context."""
    return _OWN_FOLDER.get()


def config_file(group: str, option: str) -> Path:
    """Return the file of an option, in the project or in the folder of `own_configs`."""
    own, file = own_folder(), Path(group, f"{option}.yaml")
    return own / file if own and (own / file).is_file() else configs_folder() / file


def _files(folder: Path) -> dict[str, set[str]]:
    """Return the options that files define, by group."""
    return {group.name: _names(group) for group in filter(Path.is_dir, folder.iterdir())}


def _names(group: Path) -> set[str]:
    return {str(file.relative_to(group).with_suffix("")) for file in group.rglob("*.yaml")}


def options() -> dict[str, tuple[str, ...]]:
    """Return the options of each group (`env`, `algo`, `experiment`, ...), sorted by name."""
    groups = {*_REGISTERED, *_files(configs_folder())}
    return {group: option_names(group) for group in sorted(groups)}


def option_names(group: str) -> tuple[str, ...]:
    """Return the options of one group as `options` does, without loading what other groups register."""
    folders = filter(None, (configs_folder(), own_folder()))
    found = [_names(folder / group) for folder in folders]
    return tuple(sorted({*_REGISTERED.get(group, dict)()}.union(*found)))


def store_registered() -> None:
    """Make the registered names known to Hydra. A file of the same name takes precedence."""
    from hydra.core.config_store import ConfigStore

    store = ConfigStore.instance()
    for group, nodes in {**_registered(), "env": {NO_ENV: {"id": "???"}, **_registered()["env"]}}.items():
        for name, node in nodes.items():
            store.store(name, node, group)


def summary_of(group: str, option: str) -> str:
    """Return the first sentence of a configuration file's first comment, Hydra directives aside."""
    lines = config_file(group, option).read_text(encoding="utf-8").splitlines()
    text_lines = (line for line in lines if not line.startswith("# @"))
    comment = takewhile(
        lambda line: line.startswith("#"), dropwhile(lambda line: not line.strip("# "), text_lines)
    )
    text = " ".join(line.removeprefix("#").strip() for line in comment)
    sentence = _SENTENCE.match(text)
    return sentence[0] if sentence else text


def _registered() -> Mapping[str, Mapping[str, Mapping[str, Any]]]:
    """Return the keys that each option without a file sets, by group and option."""
    return {group: found() for group, found in _REGISTERED.items()}


_REGISTERED: Mapping[str, Callable[[], Mapping[str, Mapping[str, Any]]]] = {
    "env": lambda: {name: {"id": name} for name in env_entries()},
    "algo": lambda: {name: {"name": name} for name in algo_entries()},
    "backend": lambda: {name: {"name": name} for name in literal_choices(BackendConfig)["name"]},
    "energy": lambda: {"codecarbon": {"enabled": True}, "off": {"enabled": False}},
}
