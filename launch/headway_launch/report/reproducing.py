"""The command line that trains a stored run again."""

import json
import re
import shlex
from collections.abc import Mapping
from typing import Any

from headway_launch.composing import compose
from headway_launch.planning import full_mapping

_WORD = re.compile(r"[A-Za-z_][\w.]*")
"""Text that needs no quotes."""
_ELSEWHERE = ("store.", "seed", "backend.name", "backend.workers", "backend.parallel")
"""Keys that change no result: where runs are kept, and how a machine is filled."""


def reproducing_line(mapping: Mapping[str, Any], seeds: str) -> str:
    """`headway run ...` with every key in which a stored configuration differs from today's defaults. `seeds`
    as on the command line.

    Raises HeadwayError if this version cannot compose it: an environment that is not installed, say.
    """
    words = [f"env={mapping['env']['id']}", f"algo={mapping['algo']['name']}"]
    defaults = dict(_flat(full_mapping(compose(words), ())))
    words += [
        f"{key}={_written(value)}"
        for key, value in _flat(mapping)
        if not key.startswith(_ELSEWHERE) and defaults.get(key, _flat) != value
    ]
    compose(words)
    return " ".join(["headway run", *map(shlex.quote, words), f"seed={seeds}"])


def _flat(mapping: Mapping[str, Any], path: str = "") -> list[tuple[str, Any]]:
    items: list[tuple[str, Any]] = []
    for key, value in mapping.items():
        if isinstance(value, Mapping) and value:
            items += _flat(value, f"{path}{key}.")
        else:
            items.append((f"{path}{key}", value))
    return items


def _written(value: object) -> str:
    """A value in Hydra's grammar."""
    if value is None:
        return "null"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, Mapping):
        return "{" + ",".join(f"{key}:{_written(inner)}" for key, inner in value.items()) + "}"
    if isinstance(value, list | tuple):
        return "[" + ",".join(_written(inner) for inner in value) + "]"
    if isinstance(value, str):
        plain = _WORD.fullmatch(value) and value.lower() not in ("null", "true", "false", "nan", "inf")
        return value if plain else json.dumps(value)
    return repr(value)
