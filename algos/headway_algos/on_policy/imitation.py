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
from headway_algos.grouping import Grouping
from headway_algos.networks.actor import Actor
from headway_algos.on_policy.updates.config import GradientUpdateConfig
from headway_algos.on_policy.updates.gradient_update import GradientUpdate
from headway_algos.on_policy.updates.losses import A2CLoss

LR = 3e-3
"""Adam's learning rate at the start of the imitation."""
EPOCHS, MINIBATCHES = 16, 1000
"""Passes over the decisions of all iterations, and minibatches per pass. Many small steps are needed, because
decisions that matter can be rare, such as a bus's visits to the service centre."""
SEQUENCE_EPOCHS, SEQUENCE_MINIBATCHES = 16, 8
"""Passes of recurrent policies over the sequences of each iteration, and minibatches per pass."""


def imitate(
    actor: Actor,
    rows: PolicyBatch,
    config: AlgoConfig,
    layout: Layout,
    generators: Sequence[np.random.Generator],
    alike: Grouping,
) -> dict[str, Tensor]:
    """Raise the likelihood of the actions in `rows`, the decisions of many iterations.

    `alike` groups the K policies of a seed whose agents are interchangeable: one network learns from the
    decisions of all policies of a group, and each of them becomes a copy of it. The learning rate falls
    linearly from pass to pass. Returns metrics (R x groups,) of the last pass, NaN for groups without rows. A
    Gaussian's spread is kept for exploration.
    """
    # The group, of R x groups, of each of the P policies, and the first policy of each group.
    group_of = alike.policies(layout.replicas, layout.replicas).ravel()
    first = np.unique(group_of, return_index=True)[1]
    learned, update = _update(actor, config, layout, first, 1, MINIBATCHES)
    rows = _joined(rows, alike, layout.replicas)
    info: dict[str, Tensor] = {}
    for epoch in range(EPOCHS):
        update.anneal(1 - epoch / EPOCHS)
        info = update.improve(rows, torch.ones_like(rows.log_probs), [generators[place] for place in first])
    _take_over(actor, learned, group_of)
    return info


def _joined(rows: PolicyBatch, alike: Grouping, replicas: int) -> PolicyBatch:
    """Return rows (R x K, B, ...) by group, (R x groups, G x B, ...); G: policies of the largest group."""

    def joined(column: Tensor) -> Tensor:
        by_seed = column.reshape(replicas, -1, *column.shape[1:])[:, alike.members.ravel()]
        return by_seed.reshape(replicas * alike.num_policies, -1, *column.shape[2:])

    members = np.repeat(np.tile(alike.is_member, (replicas, 1)), rows.selected.shape[1], axis=1)
    return PolicyBatch(
        joined(rows.observations),
        None if rows.masks is None else joined(rows.masks),
        joined(rows.actions),
        joined(rows.log_probs),
        joined(torch.from_numpy(rows.selected)).numpy() & members,
    )


def imitate_sequences(
    actor: Actor,
    rows: PolicyBatch,
    config: AlgoConfig,
    layout: Layout,
    generators: Sequence[np.random.Generator],
    share: float,
) -> dict[str, Tensor]:
    """Raise the likelihood of recurrent policies' actions in one iteration's rows, taken as sequences.

    Adam starts anew with every call; only the networks are carried from one call to the next. `share`, a
    factor on the learning rate, should fall from call to call: an iteration may contain only one part of an
    episode, and later iterations would overwrite what was learned from it.
    """
    policies = np.arange(layout.replicas * layout.grouping.num_policies)
    learned, update = _update(actor, config, layout, policies, SEQUENCE_EPOCHS, SEQUENCE_MINIBATCHES)
    update.anneal(share)
    info = update.improve(rows, torch.ones_like(rows.log_probs), generators)
    _take_over(actor, learned, policies)
    return info


def _update(
    actor: Actor,
    config: AlgoConfig,
    layout: Layout,
    policies: NDArray[np.int64],
    epochs: int,
    minibatches: int,
) -> tuple[Actor, GradientUpdate]:
    """Return a copy of some policies of the actor, by their indices, and the update that trains it.

    The actor itself is not trained because its parameters belong to the optimiser of the learner's update.
    """
    learned = actor.narrow(torch.from_numpy(policies).to(layout.device))
    settings = GradientUpdateConfig(
        model=config.model, lr=LR, grad_clip=None, piece_samples=config.piece_samples
    )
    # With advantages of 1 A2C's loss is the negative log-likelihood.
    loss = A2CLoss(config.imitation_entropy_coeff)
    return learned, GradientUpdate(learned, settings, layout, loss, epochs, minibatches)


def _take_over(actor: Actor, learned: Actor, places: NDArray[np.int64]) -> None:
    """Copy network `places[p]` of `learned` to each policy p of the actor; places (P,)."""
    with torch.no_grad():
        for own, found in zip(actor.network.parameters(), learned.network.parameters(), strict=True):
            own.copy_(found[torch.from_numpy(places).to(found.device)])


def decisions(rows: PolicyBatch, nvec: Sequence[int]) -> PolicyBatch:
    """Return the rows with only those decisions selected that show the rule's preference.

    The action mask must allow the rule's action (the environment overrides forbidden ones) and at least one
    other.
    """
    if rows.masks is None:
        return rows
    options = rows.actions[..., None]
    if nvec:
        options = rows.actions + torch.tensor([0, *nvec[:-1]], device=rows.actions.device).cumsum(0)
    allowed = rows.masks.gather(2, options).all(2)
    sizes = list(nvec) or [rows.masks.shape[2]]
    several = (torch.stack([part.sum(2) for part in torch.split(rows.masks, sizes, 2)]) > 1).any(0)
    return replace(rows, selected=rows.selected & (allowed & several).cpu().numpy())
