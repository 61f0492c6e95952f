"""Options of each group of an experiment: files of `configs`, and registered names, which need no file."""

import re
from collections.abc import Mapping
from itertools import dropwhile, takewhile
from pathlib import Path
from typing import Any

from headway.config.experiment import BackendConfig
from headway.config.schema import literal_choices
from headway.contracts.errors import HeadwayError
from headway.registry import algo_entries, env_entries

NO_ENV = "none"
"""The option of the group `env` that applies if none is chosen."""
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


def options() -> dict[str, tuple[str, ...]]:
    """Return the options of each group (`env`, `algo`, `experiment`, ...), sorted by name."""
    names = {group: set(values) for group, values in _registered().items()}
    for folder in filter(Path.is_dir, configs_folder().iterdir()):
        files = {str(file.relative_to(folder).with_suffix("")) for file in folder.rglob("*.yaml")}
        names[folder.name] = names.get(folder.name, set()) | files
    return {group: tuple(sorted(names[group])) for group in sorted(names)}


def store_registered() -> None:
    """Make the registered names known to Hydra. A file of the same name takes precedence."""
    from hydra.core.config_store import ConfigStore

    store = ConfigStore.instance()
    for group, nodes in {**_registered(), "env": {NO_ENV: {"id": "???"}, **_registered()["env"]}}.items():
        for name, node in nodes.items():
            store.store(name, node, group)


def summary_of(group: str, option: str) -> str:
    """Return the first sentence of a configuration file's first comment, Hydra directives aside."""
    lines = (configs_folder() / group / f"{option}.yaml").read_text(encoding="utf-8").splitlines()
    text_lines = (line for line in lines if not line.startswith("# @"))
    comment = takewhile(
        lambda line: line.startswith("#"), dropwhile(lambda line: not line.strip("# "), text_lines)
    )
    text = " ".join(line.removeprefix("#").strip() for line in comment)
    sentence = _SENTENCE.match(text)
    return sentence[0] if sentence else text


def _registered() -> Mapping[str, Mapping[str, Mapping[str, Any]]]:
    """Return the keys that each option without a file sets, by group and option."""
    return {
        "env": {name: {"id": name} for name in env_entries()},
        "algo": {name: {"name": name} for name in algo_entries()},
        "backend": {name: {"name": name} for name in literal_choices(BackendConfig)["name"]},
        "energy": {"codecarbon": {"enabled": True}, "off": {"enabled": False}},
    }
