"""Environments and algorithms by name: the project's own and those that other packages add by entry point."""

from collections.abc import Mapping
from functools import cache
from importlib.metadata import entry_points
from typing import Any, TypeVar

from headway.configuration import suggestion
from headway.contracts.entries import AlgoEntry, EnvEntry
from headway.contracts.errors import HeadwayError

Entry = TypeVar("Entry", EnvEntry, AlgoEntry)


@cache
def env_entries() -> Mapping[str, EnvEntry]:
    """Every environment by name. Raises HeadwayError where a package's entry point cannot be loaded."""
    return _load("headway.envs", EnvEntry)


@cache
def algo_entries() -> Mapping[str, AlgoEntry]:
    """Every algorithm by name. Raises HeadwayError where a package's entry point cannot be loaded."""
    return _load("headway.algos", AlgoEntry)


def env_entry(name: str) -> EnvEntry:
    """The environment of that name. Raises HeadwayError with the nearest name if there is none."""
    return _named(env_entries(), name, "environment")


def algo_entry(name: str) -> AlgoEntry:
    """The algorithm of that name. Raises HeadwayError with the nearest name if there is none."""
    return _named(algo_entries(), name, "algorithm")


def _named(entries: Mapping[str, Entry], name: str, kind: str) -> Entry:
    try:
        return entries[name]
    except KeyError:
        raise HeadwayError(f"{name!r} is no {kind}; {suggestion(name, entries)}") from None


def _load(group: str, kind: type[Entry]) -> Mapping[str, Entry]:
    entries: dict[str, Entry] = {}
    for point in entry_points(group=group):
        origin = point.dist.name if point.dist else point.value
        try:
            added: Any = point.load()
        except Exception as error:
            raise HeadwayError(
                f"{point.value} of package {origin} cannot be loaded ({type(error).__name__}: {error}); "
                "mend or uninstall that package"
            ) from error
        if not isinstance(added, Mapping) or not all(isinstance(entry, kind) for entry in added.values()):
            raise HeadwayError(
                f"{point.value} of package {origin} must be a mapping from names to {kind.__name__}"
            )
        for name, entry in added.items():
            if name in entries:
                raise HeadwayError(f"{name!r} is registered twice in {group}, once by package {origin}")
            entries[name] = entry
    return dict(sorted(entries.items()))
