"""Configuration classes of the on-policy algorithms, assembled from those of their components.

Imports no torch.
"""

from collections.abc import Mapping
from dataclasses import field, fields, make_dataclass
from functools import cache
from typing import Any, ClassVar, Literal, get_type_hints

from headway_algos.components import KINDS, component, names
from headway_algos.config import AlgoConfig
from headway_algos.migration import OBSOLETE_KEYS
from headway_algos.on_policy.critics.config import CriticConfig
from headway_algos.recipes import Recipe, recipes

DEFAULT_COMPONENTS = {"critic": "local", "update": "ppo", "critic_update": "adam", "order": "simultaneous"}
"""Components of `algo=custom` unless others are chosen."""


def config_class(recipe: Recipe, chosen: Mapping[str, Any]) -> type[AlgoConfig]:
    """Return the configuration class of an algorithm, given the values of the keys that choose components.

    An unknown name of a component is treated as unset; `headway.config.schema.build` raises the error.
    """
    used = []
    for kind in KINDS:
        fixed, name = getattr(recipe, kind), chosen.get(kind)
        if fixed is None and name not in names(kind):
            name = recipe.defaults.get(kind, DEFAULT_COMPONENTS[kind])
        used.append((kind, fixed or str(name)))
    return _config_class(recipe, tuple(used))


def rollout(recipe: Recipe, config: AlgoConfig) -> Mapping[str, int]:
    """Return the algorithm's defaults for keys of `rollout`: see `AlgoEntry.rollout`."""
    return component("update", config.update).rollout if recipe.rollout is None else recipe.rollout


def obsolete_keys(recipe: Recipe) -> dict[str, Any]:
    """Return the keys without effect that earlier versions stored: see `AlgoEntry.obsolete_keys`."""
    return {**OBSOLETE_KEYS, **recipe.fixed}


@cache
def _config_class(recipe: Recipe, used: tuple[tuple[str, str], ...]) -> type[AlgoConfig]:
    """Return the class with the keys of a recipe's components, given the name of each by kind."""
    chosen = dict(used)
    parts = [component(kind, chosen[kind]).config for kind in ("order", "update", "critic")]
    choices = ["critic", "update", "order"]
    if issubclass(parts[-1], CriticConfig):
        # First: its `critic_lr` takes precedence over those of the update and the critic.
        parts.insert(0, component("critic_update", chosen["critic_update"]).config)
        choices.insert(2, "critic_update")
    bases = tuple(dict.fromkeys(part for part in (recipe.config, *parts) if part is not AlgoConfig))
    hints = {name: hint for base in reversed(bases) for name, hint in get_type_hints(base).items()}
    # A dataclass takes every field of its first base, also those that the base inherits. Here a default that
    # one component changes takes precedence over what others inherit, as class attributes do.
    joined = type("Joined", bases or (AlgoConfig,), {})
    keys = dict.fromkeys(each.name for base in bases for each in fields(base))
    inherited = {key: getattr(joined, key) for key in keys if hasattr(joined, key)}
    defaults = {**inherited, **recipe.defaults, "name": recipe.name}
    changed: list[tuple[str, Any, Any]] = [(kind, *_choice(recipe, kind, chosen[kind])) for kind in choices]
    changed += [
        (key, hints[key], field(default=value))
        for key, value in defaults.items()
        if key in hints and key not in (*choices, *recipe.fixed)
    ]
    changed += [(key, ClassVar[hints[key]], field(default=value)) for key, value in recipe.fixed.items()]

    def reduced(config: AlgoConfig) -> tuple[Any, ...]:
        """Reduce a record, for pickling, to what its class is made from, and its values."""
        return _restored, (recipe, used, {each.name: getattr(config, each.name) for each in fields(config)})

    made = make_dataclass(
        f"{recipe.name.upper()}Config",
        changed,
        bases=bases or (AlgoConfig,),
        namespace={"__reduce__": reduced, "__doc__": recipe.summary},
        frozen=True,
    )
    made.__module__ = __name__
    return made


def _choice(recipe: Recipe, kind: str, used: str) -> tuple[Any, Any]:
    """Return the type of a key that chooses a component, and its field with default and documentation."""
    fixed = getattr(recipe, kind) is not None
    known = [used] if fixed else names(kind)
    if fixed:
        doc = f"{component(kind, used).summary} {_related(recipe, kind)}"
    else:
        described = [f"`{name}`: {KINDS[kind][name].summary}" for name in known if name in KINDS[kind]]
        doc = " ".join(described)
    return Literal[tuple(known)], field(default=used, metadata={"doc": doc})


def _related(recipe: Recipe, kind: str) -> str:
    """Return a line that names the algorithms that differ only in their component of this kind."""
    kinds = ("critic", "update", "order")
    related = [
        f"for {getattr(each, kind)}: algo={each.name}"
        for each in recipes().values()
        if isinstance(each, Recipe)
        and kind in kinds
        and getattr(each, kind) not in (None, getattr(recipe, kind))
        and all(getattr(each, other) == getattr(recipe, other) for other in kinds if other != kind)
        and each.contributor is None
    ]
    return "; ".join((*related, "any with algo=custom")).capitalize() + "."


def _restored(recipe: Recipe, used: tuple[tuple[str, str], ...], values: dict[str, Any]) -> AlgoConfig:
    return _config_class(recipe, used)(**values)
