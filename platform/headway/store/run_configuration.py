"""The configuration in a run's folder, in the form of this version."""

from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

from headway.config.experiment import without_password
from headway.contracts.errors import HeadwayError
from headway.registry import algo_entries
from headway.store.atomic_files import require_regular

_MAX_DEPTH = 100
"""Maximum number of nested levels in a configuration."""
_MAX_NODES = 100_000
"""Maximum number of keys and values in a configuration."""


def read_configuration(directory: Path) -> dict[str, Any]:
    """Return the configuration in a run's folder, `upgraded`. Raises HeadwayError if it cannot be read."""
    import yaml

    path = directory / "config.yaml"
    remedy = "restore it, or remove this run's folder"
    require_regular(path)
    # The C loader is ten times faster, which is noticeable in studies with hundreds of runs.
    loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
    try:
        text = path.read_text(encoding="utf-8")
        require_small_yaml(text)
        mapping = yaml.load(text, loader)
    except FileNotFoundError as error:
        raise HeadwayError(f"{path} is missing: {remedy}") from error
    except (OSError, ValueError, yaml.YAMLError) as error:
        reason = getattr(error, "strerror", None) or str(error).splitlines()[0]
        raise HeadwayError(f"{path} cannot be read ({reason}): {remedy}") from error
    if not isinstance(mapping, dict):
        raise HeadwayError(f"{path} holds no configuration: {remedy}")
    return upgraded(mapping)


def require_small_yaml(text: str) -> None:
    """Raise ValueError for YAML too deep, or too long once its aliases are expanded, to be read in reasonable
    time.

    Raises yaml.YAMLError for text that is not YAML.
    """
    import yaml

    sizes: dict[str, int] = {}
    open_nodes: list[tuple[str | None, int]] = []
    total = 0
    for event in yaml.parse(text, getattr(yaml, "CSafeLoader", yaml.SafeLoader)):
        if isinstance(event, yaml.CollectionStartEvent):
            open_nodes.append((event.anchor, total))
            if len(open_nodes) > _MAX_DEPTH:
                raise ValueError(f"it is nested more than {_MAX_DEPTH} levels deep")
        elif isinstance(event, yaml.CollectionEndEvent):
            anchor, before = open_nodes.pop()
            if anchor is not None:
                sizes[anchor] = total - before
        total += sizes.get(event.anchor or "", 1) if isinstance(event, yaml.AliasEvent) else 1
        if total > _MAX_NODES:
            raise ValueError(f"it has more than {_MAX_NODES:,} nodes, aliases written out")


def upgraded(mapping: Mapping[str, Any]) -> dict[str, Any]:
    """Return a configuration stored by an earlier version in the form of this version.

    Newer hyper-parameters that the algorithm has are set to the value that reproduces the old behaviour.
    """
    store = mapping.get("store")
    if isinstance(store, Mapping) and isinstance(uri := store.get("tracking_uri"), str):
        mapping = {**mapping, "store": {**store, "tracking_uri": without_password(uri)}}
    algo = mapping.get("algo")
    entry = algo_entries().get(algo.get("name", "")) if isinstance(algo, Mapping) else None
    if entry is None or not isinstance(algo, Mapping):
        return dict(mapping)
    own = {each.name for each in fields(entry.config)}
    before = {key: value for key, value in getattr(entry.config, "VALUES_BEFORE", {}).items() if key in own}
    return {**mapping, "algo": {**before, **algo}}
