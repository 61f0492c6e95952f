"""From one command line to the cells of a sweep, in Hydra's grammar."""

from collections.abc import Sequence
from itertools import product

from headway.config.schema import parse_seeds
from headway.contracts.errors import HeadwayError
from headway_launch.experiments.compose import Experiment, compose, groups
from headway_launch.experiments.parameters import session_settings

_FORMS = "write KEY=a,b, KEY=choice(a,b) or KEY=range(0,5)"


def compose_sweep(overrides: Sequence[str]) -> list[Experiment]:
    """The experiments that `overrides` describe, one a combination of the values that they list
    (`algo=ippo,mappo algo.lr=choice(1e-3,3e-4)`), the last key changing fastest; seeds stay together.

    Raises HeadwayError for what cannot be used, and for a list of values of what a session has one of.
    """
    experiments = [compose(chosen) for chosen in combinations(overrides)]
    require_one_session(experiments)
    return experiments


def combinations(overrides: Sequence[str]) -> list[tuple[str, ...]]:
    """Every combination of the values of `overrides`, each with one value a key but `seed`.

    Raises HeadwayError for an override that cannot be read.
    """
    return [tuple(chosen) for chosen in product(*(_values(override) for override in overrides))]


def _values(override: str) -> list[str]:
    key, separator, text = override.partition("=")
    if not separator or key.lstrip("+~") in ("seed", "study"):
        return [_all_seeds(override, text) if key.lstrip("+") == "seed" else override]
    from hydra.core.override_parser.overrides_parser import OverridesParser
    from hydra.core.override_parser.types import Glob
    from hydra.errors import HydraException

    try:
        parsed = OverridesParser.create().parse_override(override)
    except HydraException:
        return [override]  # `compose` says what is wrong with it
    if not parsed.is_sweep_override():
        return [override]
    value = parsed.value()
    if isinstance(value, Glob):
        options = value.filter(list(groups().get(key, ())))
        if not options:
            raise HeadwayError(f"{override} matches nothing; {_FORMS}")
        return [f"{key}={option}" for option in options]
    if not (parsed.is_choice_sweep() or parsed.is_range_sweep()):
        raise HeadwayError(f"{override} has no values to go through; {_FORMS}")
    return [f"{key}={option}" for option in parsed.sweep_string_iterator()]


def _all_seeds(override: str, text: str) -> str:
    """`choice(...)` of seeds is a list of them, not a cell each."""
    inner = text.strip()
    if inner.startswith("choice(") and inner.endswith(")"):
        seeds = parse_seeds(inner.removeprefix("choice(").removesuffix(")"))
        return f"seed={','.join(map(str, seeds))}"
    return override


def require_one_session(experiments: Sequence[Experiment]) -> None:
    """Raises HeadwayError where experiments differ in what a session has one of."""
    wanted, *others = (session_settings(experiment.config) for experiment in experiments)
    for name, value in wanted.items():
        if any(other[name] != value for other in others):
            raise HeadwayError(f"{name} has one value in a sweep; give {name} one, or sweep once for each")
