"""Command line that repeats the training of a stored run."""

import json
import shlex
from collections.abc import Mapping, Sequence
from contextlib import suppress
from functools import lru_cache
from types import MappingProxyType
from typing import Any

from headway.adapters.env_file import is_file_id
from headway.config.experiment import NO_PRESET
from headway.contracts.errors import HeadwayError
from headway_launch.experiments.compose import compose
from headway_launch.experiments.options import options
from headway_launch.experiments.override_words import written
from headway_launch.experiments.parameters import flat, full_mapping

_BACKEND = ("name", "workers", "parallel", "address", "worker_cpus", "learners")
_NO_EFFECT = ("store.", "seed", "preset", "candidate", *(f"backend.{key}" for key in _BACKEND))
"""Keys without effect on results: storage, distribution over processes, and origin of settings."""


def reproducing_line(mapping: Mapping[str, Any], seeds: str, file: str) -> str:
    """Return `headway run ...` with every key that differs from today's defaults and preset.

    `seeds`: as on the command line. `file`: path of the configuration, which the line names if the
    environment is in a file, because composing overrides would run that file. Raises HeadwayError if this
    version cannot compose the configuration, for instance because an environment is not installed.
    """
    env = mapping.get("env")
    if isinstance(env, Mapping) and is_file_id(str(env.get("id"))):
        return f"headway run {file} seed={seeds}"
    preset = mapping.get("preset") or NO_PRESET
    return f"{_line_without_seeds(json.dumps(_changing_results(mapping)), preset)} seed={seeds}"


@lru_cache(maxsize=1024)
def _line_without_seeds(keys: str, preset: str) -> str:
    """Return the line for configuration `keys`, JSON pairs of key and value.

    Cached, because composing takes a third of a second and the seeds of a cell share the configuration.
    """
    values = dict(json.loads(keys))
    if preset != NO_PRESET:
        # The preset may have been removed, or may now set values that overrides cannot undo.
        with suppress(HeadwayError):
            words = _words(values, preset)
            if _composed(words) == values:
                return _line(words)
    words = _words(values, NO_PRESET)
    compose(words)
    return _line(words)


def _line(words: Sequence[str]) -> str:
    return " ".join(["headway run", *map(shlex.quote, words)])


def _words(values: Mapping[str, Any], preset: str) -> list[str]:
    chosen = [f"env={values['env.id']}", f"algo={values['algo.name']}"]
    by_default = f"default_{values['env.id']}" in options()["preset"]
    chosen += [f"preset={preset}"] if preset != NO_PRESET or by_default else []
    known = _chosen(*chosen)
    differing = [key for key, value in values.items() if key not in known or known[key] != value]
    return [*chosen, *(f"{key}={written(values[key])}" for key in differing)]


@lru_cache(maxsize=128)
def _chosen(*words: str) -> Mapping[str, Any]:
    """Return `_composed` of words that many cells share: environment, algorithm and preset."""
    return MappingProxyType(_composed(words))


def _composed(words: Sequence[str]) -> dict[str, Any]:
    return dict(_changing_results(full_mapping(compose(words), ())))


def _changing_results(mapping: Mapping[str, Any]) -> list[tuple[str, Any]]:
    return [(key, value) for key, value in flat(mapping, with_empty=True) if not key.startswith(_NO_EFFECT)]
