"""Composition of the cells of a sweep from one command line in Hydra's grammar."""

import re
from collections.abc import Sequence
from itertools import islice, product
from math import prod

from headway.config.schema import parse_seeds
from headway.contracts.errors import HeadwayError
from headway_launch.experiments.compose import compose
from headway_launch.experiments.experiment import Experiment
from headway_launch.experiments.options import options
from headway_launch.experiments.parameters import session_settings

_MAX_CELLS = 1_000
"""Maximum number of combinations in a sweep."""
_FORMS = "write KEY=a,b, KEY=choice(a,b) or KEY=range(0,5)"


def compose_sweep(overrides: Sequence[str]) -> list[Experiment]:
    """Return one experiment per combination of the values that `overrides` list; seeds stay together.

    For example `algo=ippo,mappo algo.lr=choice(1e-3,3e-4)`; the last key varies fastest. Raises HeadwayError
    for an invalid override, and for several values of a key in `session_settings`.
    """
    experiments = [compose(chosen) for chosen in combinations(overrides)]
    require_one_session(experiments)
    return experiments


def combinations(overrides: Sequence[str]) -> list[tuple[str, ...]]:
    """Return every combination of the values of `overrides`, with one value per key except `seed`.

    Raises HeadwayError for an override without values to sweep, and for more than 1,000 combinations.
    """
    values = [_swept_values(override) for override in overrides]
    if prod(map(len, values)) > _MAX_CELLS:
        longest = overrides[max(range(len(values)), key=lambda place: len(values[place]))]
        raise HeadwayError(f"{longest}: a sweep has at most {_MAX_CELLS:,} combinations; give fewer values")
    return list(product(*values))


def _swept_values(override: str) -> list[str]:
    key, separator, text = override.partition("=")
    if key.lstrip("+") == "study" and ("," in text or text.startswith("choice(")):
        raise HeadwayError(f"{override}: a sweep has one study; give one name")
    if not separator or key.lstrip("+~") in ("seed", "study"):
        return [_seed_list(override, text) if key.lstrip("+") == "seed" else override]
    from hydra.core.override_parser.overrides_parser import OverridesParser
    from hydra.core.override_parser.types import Glob
    from hydra.errors import HydraException

    try:
        parsed = OverridesParser.create().parse_override(override)
    except HydraException:
        return [override]  # `compose` reports the error
    if not parsed.is_sweep_override():
        return [override]
    value = parsed.value()
    if isinstance(value, Glob):
        matching = value.filter(list(options().get(key, ())))
        if not matching:
            raise HeadwayError(f"{override} matches nothing; {_FORMS}")
        return [f"{key}={option}" for option in matching]
    if not (parsed.is_choice_sweep() or parsed.is_range_sweep()):
        raise HeadwayError(f"{override} has no values to sweep; {_FORMS}")
    try:
        listed = list(islice(parsed.sweep_string_iterator(), _MAX_CELLS + 1))
    except ValueError as error:  # a step of 0
        raise HeadwayError(f"{override}: {error}; {_FORMS}") from error
    if not listed:
        raise HeadwayError(f"{override} has no values to sweep; {_FORMS}")
    if key == "env":  # Hydra escapes blanks in paths, which `compose` takes as they are
        listed = [re.sub(r"\\(.)", r"\1", option) for option in listed]
    return [f"{key}={option}" for option in listed]


def _seed_list(override: str, text: str) -> str:
    """Return an override of `seed` with `choice(...)` as a list: seeds share a cell."""
    inner = text.strip()
    if inner.startswith("choice(") and inner.endswith(")"):
        seeds = parse_seeds(inner.removeprefix("choice(").removesuffix(")"))
        return f"seed={','.join(map(str, seeds))}"
    return override


def require_one_session(experiments: Sequence[Experiment]) -> None:
    """Raise HeadwayError if experiments differ in `session_settings`."""
    first, *others = (session_settings(experiment.config) for experiment in experiments)
    for name, value in first.items():
        if any(other[name] != value for other in others):
            raise HeadwayError(f"{name} takes one value per sweep; set one, or run one sweep per value")
