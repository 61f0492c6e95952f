"""Named algorithms, one short file each: equations, source and composition. Imports no torch."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from importlib import import_module
from pkgutil import iter_modules
from typing import Any

from headway.contracts import Box, Contributor, Discrete, EnvSpec, Lazy, Learner
from headway_algos.config import AlgoConfig
from headway_algos.replay_config import ReplayConfig

KERNELS = ("headway_algos.kernels",)
"""Modules of compiled kernels. Every algorithm uses at least Adam's."""
LEARNER = Lazy("headway_algos.on_policy.make_learner:make_learner")


@dataclass(frozen=True)
class Recipe:
    """An on-policy algorithm: the components that it fixes, and its defaults for their keys."""

    name: str
    summary: str
    """One line for `headway list algos`."""
    source: str
    """Paper, with its arXiv number."""
    critic: str | None = None
    """Name of the critic; None: any."""
    update: str | None = None
    """Name of the policy update; None: any."""
    order: str | None = None
    """Name of the order; None: any."""
    critic_update: str | None = None
    """Name of the critic's optimiser; None: any."""
    defaults: Mapping[str, Any] = field(default_factory=dict)
    """Defaults that differ from those of the components' records."""
    fixed: Mapping[str, Any] = field(default_factory=dict)
    """Fixed values of components' keys, which users cannot set."""
    config: type[AlgoConfig] = AlgoConfig
    """Record of the keys that belong to no component."""
    rollout: Mapping[str, int] | None = None
    """Defaults of keys of `rollout`; None: those of the update."""
    learner: Callable[[Any, EnvSpec, Sequence[int], str], Learner] = LEARNER
    """Constructor of the learner: see `headway.contracts.AlgoEntry.learner`."""
    contributor: Callable[[Any, EnvSpec, Sequence[int]], Contributor] | None = None
    """Constructor of a worker's contributor, for asynchronous algorithms: see `AlgoEntry.contributor`."""
    preload: tuple[str, ...] = ()
    """Modules imported once for all processes that run contributors."""

    # Mappings have no hash, and configuration classes are cached per recipe.
    def __hash__(self) -> int:
        return hash(self.name)


@dataclass(frozen=True)
class ReplayRecipe:
    """An off-policy algorithm: its record and its method of learning from replayed transitions."""

    name: str
    summary: str
    """One line for `headway list algos`."""
    source: str
    """Paper, with its arXiv number."""
    config: type[ReplayConfig]
    actions: type[Discrete] | type[Box]
    """Action space required, which also decides how the algorithm explores."""
    make_method: Lazy
    """A `headway_algos.off_policy.learner.MakeMethod`."""


@cache
def recipes() -> dict[str, Recipe | ReplayRecipe]:
    """Return the recipes of this folder's modules, by name."""
    modules = [import_module(f"{__name__}.{module.name}") for module in iter_modules(__path__)]
    return {module.RECIPE.name: module.RECIPE for module in modules}
