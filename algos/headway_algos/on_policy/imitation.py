"""Imitation of a rule's actions by maximum likelihood (behavioural cloning), from which policies start."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from headway_algos.batches.layout import Layout
from headway_algos.batches.policy_batch import PolicyBatch
from headway_algos.config import AlgoConfig
from headway_algos.networks.actor import Actor
from headway_algos.on_policy.updates.config import GradientUpdateConfig
from headway_algos.on_policy.updates.gradient_update import GradientUpdate
from headway_algos.on_policy.updates.losses import A2CLoss

LR, EPOCHS, MINIBATCHES = 3e-3, 16, 8
"""Adam's learning rate, and passes over an iteration's rows in so many minibatches each."""
ENTROPY_COEFF = 0.3
"""Weight of the entropy, without which a policy that imitates a deterministic rule no longer explores: with
two actions the probability of the rule's tends to 0.97 instead of 1."""


def imitate(
    actor: Actor,
    rows: PolicyBatch,
    config: AlgoConfig,
    layout: Layout,
    generators: Sequence[np.random.Generator],
    share: float,
) -> dict[str, Tensor]:
    """Raise the likelihood of the actions in `rows`; return metrics (P,), NaN for policies without rows.

    Adam starts anew with every call, and a Gaussian's spread is kept for exploration, so that nothing is
    carried from one call to the next but the networks. `share`, of the learning rate, should fall from call
    to call: an iteration may show one part of an episode only, which the next would overwrite.
    """
    # A copy, since the update that learns afterwards has the actor's parameters in its own optimiser.
    learned = actor.narrow(torch.arange(len(rows.selected), device=layout.device))
    settings = GradientUpdateConfig(
        model=config.model, lr=LR * share, grad_clip=None, piece_samples=config.piece_samples
    )
    # With advantages of 1 A2C's loss is the negative log-likelihood.
    update = GradientUpdate(learned, settings, layout, A2CLoss(ENTROPY_COEFF), EPOCHS, MINIBATCHES)
    rows = replace(rows, selected=rows.selected & _allowed(rows, actor.nvec))
    info = update.improve(rows, torch.ones_like(rows.log_probs), generators)
    with torch.no_grad():
        for own, found in zip(actor.network.parameters(), learned.network.parameters(), strict=True):
            own.copy_(found)
    return info


def _allowed(rows: PolicyBatch, nvec: Sequence[int]) -> NDArray[np.bool_]:
    """Return where the mask allows the action, (P, B): a rule may choose what the environment overrides."""
    if rows.masks is None:
        return np.ones_like(rows.selected)
    options = rows.actions[..., None]
    if nvec:
        options = rows.actions + torch.tensor([0, *nvec[:-1]], device=rows.actions.device).cumsum(0)
    allowed: NDArray[np.bool_] = rows.masks.gather(2, options).all(2).cpu().numpy()
    return allowed
