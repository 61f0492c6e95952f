"""Changed keys of the environment for the evaluation or verification of a stored run."""

from collections.abc import Mapping, Sequence
from copy import deepcopy
from typing import Any

from headway.contracts.errors import HeadwayError
from headway_launch.experiments.compose import require_grammar


def with_env_args(mapping: Mapping[str, Any], overrides: Sequence[str]) -> tuple[dict[str, Any], list[str]]:
    """Return a stored configuration with changed environment arguments, and a description of the changes.

    `overrides`: `env.args.KEY=VALUE` in Hydra's grammar. Raises HeadwayError for other keys, which concern
    training only.
    """
    for override in overrides:
        if not override.startswith("env.args.") or "=" not in override:
            raise HeadwayError(
                f"{override}: a trained policy keeps its own configuration; only env.args.KEY=VALUE can be "
                "changed, and options such as --episodes and --rules"
            )
    return with_env_keys(mapping, overrides)


def with_env_keys(mapping: Mapping[str, Any], overrides: Sequence[str]) -> tuple[dict[str, Any], list[str]]:
    """Return a stored configuration with changed keys of `env`, and a description of each change.

    `overrides`: `env.KEY=VALUE` in Hydra's grammar, with one value. Raises HeadwayError for others, and for a
    key below a value that has no keys.
    """
    from hydra.core.override_parser.overrides_parser import OverridesParser

    changed, changes = deepcopy(dict(mapping)), []
    for override in overrides:
        key = override.partition("=")[0]
        require_grammar([override])
        parsed = OverridesParser.create().parse_override(override)
        if parsed.is_sweep_override():
            raise HeadwayError(f"{override}: give one value")
        _, *parents, name = key.split(".")
        place = changed.get("env")
        for parent in parents:
            place = place.setdefault(parent, {}) if isinstance(place, dict) else None
        if not isinstance(place, dict):
            raise HeadwayError(f"{override}: {key.rpartition('.')[0]} has no keys; give its value")
        trained = f" (trained with {place[name]})" if name in place else ""
        changes.append(f"{override}{trained}")
        place[name] = parsed.value()
    return changed, changes
