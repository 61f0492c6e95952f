"""The command line that trains a stored run again."""

import json
import re
import shlex
from collections.abc import Mapping
from functools import lru_cache
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
    changing_results = [(key, value) for key, value in _flat(mapping) if not key.startswith(_ELSEWHERE)]
    return f"{_line_without_seeds(json.dumps(changing_results))} seed={seeds}"


@lru_cache(maxsize=1024)
def _line_without_seeds(keys: str) -> str:
    """Composing costs a third of a second, and the seeds of a cell share it. `keys`: pairs of key and value,
    as JSON."""
    pairs = [(key, value) for key, value in json.loads(keys)]
    values = dict(pairs)
    words = [f"env={values['env.id']}", f"algo={values['algo.name']}"]
    defaults = dict(_flat(full_mapping(compose(words), ())))
    words += [f"{key}={_written(value)}" for key, value in pairs if defaults.get(key, _flat) != value]
    compose(words)
    return " ".join(["headway run", *map(shlex.quote, words)])


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
