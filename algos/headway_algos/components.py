"""Components of on-policy algorithms by name: Headway's own, and other packages'. Imports no torch."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from typing import Any

from headway.contracts import HeadwayError, Lazy
from headway_algos.config import AlgoConfig, SequentialConfig, SimultaneousConfig
from headway_algos.on_policy.critics.config import (
    AdamCriticConfig,
    CentralConfig,
    CounterfactualConfig,
    CriticConfig,
    KFACCriticConfig,
)
from headway_algos.on_policy.updates.config import A2CConfig, PPOConfig
from headway_algos.on_policy.updates.natural_config import KFACConfig, TRPOConfig


@dataclass(frozen=True)
class Component:
    """A critic, a policy update, an optimiser of critics or an update order, with its hyper-parameters."""

    summary: str
    """One sentence for `headway list algos NAME`."""
    config: type[AlgoConfig]
    """Record of its keys: a frozen dataclass that inherits from `AlgoConfig` or from another component's."""
    make: Callable[..., Any]
    """For orders the `Order` itself; else the constructor, `MakeCritic` or `MakeUpdate`, given a record that
    includes `config`. A `Lazy` if its module imports torch."""
    rollout: Mapping[str, int] = field(default_factory=dict)
    """For updates: defaults of keys of `rollout`, such as `{"steps": 16}`."""
    penalises: bool = False
    """For updates: whether `improve` adds the penalty on the distance from `rows.start`, if there is one.
    A `GradientUpdate` does."""


ONE_STEP = {"steps": 16}
"""Default with short iterations, for updates that take one policy step per iteration."""


UPDATES = {
    "ppo": Component(
        "Epochs of minibatch steps on a clipped surrogate.",
        PPOConfig,
        Lazy("headway_algos.on_policy.updates.gradient_update:ppo_update"),
        penalises=True,
    ),
    "a2c": Component(
        "One gradient step on the whole batch.",
        A2CConfig,
        Lazy("headway_algos.on_policy.updates.gradient_update:a2c_update"),
        ONE_STEP,
        penalises=True,
    ),
    "trpo": Component(
        "One natural-gradient step within a bound on the KL divergence.",
        TRPOConfig,
        Lazy("headway_algos.on_policy.updates.trpo:TRPO"),
    ),
    "kfac": Component(
        "One natural-gradient step with Kronecker factors of the Fisher information.",
        KFACConfig,
        Lazy("headway_algos.on_policy.updates.kfac:KFAC"),
        ONE_STEP,
    ),
}
CRITICS = {
    "local": Component(
        "V(o) of an agent's own observation.",
        CriticConfig,
        Lazy("headway_algos.on_policy.critics.value:LocalCritic"),
    ),
    "central": Component(
        "V(s) of the global state.",
        CentralConfig,
        Lazy("headway_algos.on_policy.critics.value:CentralCritic"),
    ),
    "event": Component(
        "V(o); what other agents do until the agent's next decision is not credited to it (after CAAC).",
        CriticConfig,
        Lazy("headway_algos.on_policy.critics.event:EventCritic"),
    ),
    "counterfactual": Component(
        "Q(s, u) for each action of the agent, the other agents' actions held fixed (Discrete actions only).",
        CounterfactualConfig,
        Lazy("headway_algos.on_policy.critics.counterfactual:CounterfactualCritic"),
    ),
    "none": Component(
        "No critic: advantages are discounted returns within the iteration (REINFORCE).",
        AlgoConfig,
        Lazy("headway_algos.on_policy.critics.no_critic:NoCritic"),
    ),
}
CRITIC_UPDATES = {
    "adam": Component(
        "Minibatch steps of Adam.",
        AdamCriticConfig,
        Lazy("headway_algos.on_policy.critics.return_regression:adam"),
    ),
    "kfac": Component(
        "Natural gradients with Kronecker factors of the Gauss-Newton matrix.",
        KFACCriticConfig,
        Lazy("headway_algos.on_policy.critics.return_regression:kfac"),
    ),
}
ORDERS = {
    "simultaneous": Component(
        "All policies are updated at once.",
        SimultaneousConfig,
        Lazy("headway_algos.on_policy.learner:simultaneous"),
    ),
    "sequential": Component(
        "One policy after another in a random order, each with its advantages weighted by the probability "
        "ratios of the policies updated before (needs several: `policies: independent` or `groups`).",
        SequentialConfig,
        Lazy("headway_algos.on_policy.sequential_order:sequential"),
    ),
}
KINDS: Mapping[str, dict[str, Component]] = {
    "critic": CRITICS,
    "update": UPDATES,
    "critic_update": CRITIC_UPDATES,
    "order": ORDERS,
}
"""Headway's components by kind (the key of `algo` that chooses one), then by name."""


def names(kind: str) -> list[str]:
    """Return the names of all components of a kind: Headway's, then those of other packages.

    Other packages register theirs by entry points such as `headway.updates`.
    """
    return [*KINDS[kind], *(name for name in _others(kind) if name not in KINDS[kind])]


def component(kind: str, name: str) -> Component:
    """Return a component by name.

    Raises HeadwayError for an unknown name, or if another package registers it as something other than a
    `Component`.
    """
    if name in KINDS[kind]:
        return KINDS[kind][name]
    if name not in (others := _others(kind)):
        raise HeadwayError(f"unknown {kind} {name!r}; available: {', '.join(sorted(names(kind)))}")
    loaded = others[name].load()
    if not isinstance(loaded, Component):
        raise HeadwayError(f"{others[name].value}, entry point of algo.{kind}={name}, must be a Component")
    return loaded


@cache
def _others(kind: str) -> dict[str, EntryPoint]:
    return {point.name: point for point in entry_points(group=f"headway.{kind}s")}
