"""How policies are improved from advantages: each update by name, with the state that it alone keeps."""

from collections.abc import Callable, Sequence
from typing import Any, Protocol, Self

import numpy as np
from torch import Tensor

from headway_algos.batches.layout import Layout
from headway_algos.batches.policy_batch import PolicyBatch
from headway_algos.config import AlgoConfig
from headway_algos.networks.actor import Actor
from headway_algos.on_policy.updates.a2c import A2C
from headway_algos.on_policy.updates.gradient_update import GradientUpdate
from headway_algos.on_policy.updates.kfac import KFAC
from headway_algos.on_policy.updates.ppo import PPO
from headway_algos.on_policy.updates.trpo import TRPO


class Update(Protocol):
    """Improves a stack of policies in place, each by itself. Whatever it carries from one improvement to
    the next (moments of an optimiser, adaptive coefficients) is its own, and in its state."""

    actor: Actor
    config: AlgoConfig

    def improve(
        self, rows: PolicyBatch, advantages: Tensor, generators: Sequence[np.random.Generator]
    ) -> dict[str, Tensor]:
        """Move the policies along advantages (P, B), used as they come; generators (P,) are for whatever it
        shuffles or draws. Rows of policies that remember are told in which sequences they stand.

        Policies without a selected row stay as they were, and so does what is carried on for them. Returns
        info, each (P,).
        """
        ...

    def anneal(self, share: float) -> None:
        """Take steps of `share` of their configured size from now on."""
        ...

    def narrow(self, policies: Tensor) -> Self:
        """The same update for policies (n,) of the stack alone, on copies of them and of what it carries on
        for them: an order that gives agents turns improves those whose turn it is, and then `adopt`s them."""
        ...

    def adopt(self, policies: Tensor, part: Self) -> None:
        """Take over what policies (n,), and what is carried on for them, became in `part`."""
        ...

    def state_dict(self) -> dict[str, Any]:
        """All that it carries on, the policies excepted: tensors, numbers, strings, lists and dicts."""
        ...

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Inverse of `state_dict`; leaves `state` as it is."""
        ...


def ppo_update(actor: Actor, config: AlgoConfig, layout: Layout) -> GradientUpdate:
    """Return PPO: epochs of minibatch steps on the clipped surrogate."""
    loss = PPO(config.clip, config.entropy_coeff)
    return GradientUpdate(actor, config, layout, loss, config.epochs, config.minibatches, config.kl_coeff)


def a2c_update(actor: Actor, config: AlgoConfig, layout: Layout) -> GradientUpdate:
    """Return A2C: one step over an iteration's rows. `epochs` and `minibatches` are the critic's alone."""
    return GradientUpdate(actor, config, layout, A2C(config.entropy_coeff))


UPDATES: dict[str, Callable[[Actor, AlgoConfig, Layout], Update]] = {
    "ppo": ppo_update,
    "a2c": a2c_update,
    "trpo": TRPO,
    "kfac": KFAC,
}
