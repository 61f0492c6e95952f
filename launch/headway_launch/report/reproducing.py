"""The command line that trains a stored run again."""

import json
import re
import shlex
from collections.abc import Mapping
from functools import lru_cache
from typing import Any

from headway_launch.composing import compose
from headway_launch.planning import flat, full_mapping

_WORD = re.compile(r"[A-Za-z_][\w.]*")
"""Text that needs no quotes."""
_BACKEND = ("name", "workers", "parallel", "address", "worker_cpus", "learners")
_ELSEWHERE = ("store.", "seed", *(f"backend.{key}" for key in _BACKEND))
"""Keys that change no result: where runs are kept, and how machines are filled."""


def reproducing_line(mapping: Mapping[str, Any], seeds: str) -> str:
    """`headway run ...` with every key in which a stored configuration differs from today's defaults. `seeds`
    as on the command line.

    Raises HeadwayError if this version cannot compose it: an environment that is not installed, say.
    """
    changing_results = [
        (key, value) for key, value in flat(mapping, with_empty=True) if not key.startswith(_ELSEWHERE)
    ]
    return f"{_line_without_seeds(json.dumps(changing_results))} seed={seeds}"


@lru_cache(maxsize=1024)
def _line_without_seeds(keys: str) -> str:
    """Composing costs a third of a second, and the seeds of a cell share it. `keys`: pairs of key and value,
    as JSON."""
    pairs = [(key, value) for key, value in json.loads(keys)]
    values = dict(pairs)
    words = [f"env={values['env.id']}", f"algo={values['algo.name']}"]
    defaults = dict(flat(full_mapping(compose(words), ()), with_empty=True))
    words += [
        f"{key}={_written(value)}" for key, value in pairs if key not in defaults or defaults[key] != value
    ]
    compose(words)
    return " ".join(["headway run", *map(shlex.quote, words)])


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
