"""Gradient steps down a policy's loss, for a stack of policies."""

from collections.abc import Sequence
from copy import copy
from typing import Any, Self

import numpy as np
import torch
from torch import Tensor

from headway_algos.batches.layout import Layout
from headway_algos.batches.minibatches import Piece
from headway_algos.batches.old_policies import OldPolicies
from headway_algos.batches.policy_batch import PolicyBatch
from headway_algos.batches.schedule import MinibatchSchedule
from headway_algos.networks.actor import Actor
from headway_algos.on_policy.updates.config import GradientUpdateConfig, PPOConfig
from headway_algos.on_policy.updates.kl_penalty import KLPenalty, mean_kl
from headway_algos.on_policy.updates.losses import (
    A2CLoss,
    LossRows,
    PolicyLoss,
    PPOLoss,
    checked_loss,
    require_reports,
)
from headway_algos.on_policy.updates.policy_kernels import compiled_policy_steps
from headway_algos.optim.adam import StackedAdam
from headway_algos.optim.gradient_steps import autograd_steps


class GradientUpdate:
    """Minimises the mean of a `PolicyLoss` and of KL penalties, if any, by Adam over minibatches.

    There are two KL penalties: PPO's adaptive one, `penalty`, and one that keeps policies near `rows.start`.
    """

    def __init__(
        self,
        actor: Actor,
        config: GradientUpdateConfig,
        layout: Layout,
        loss: PolicyLoss,
        epochs: int = 1,
        minibatches: int = 1,
        penalty: KLPenalty | None = None,
    ) -> None:
        require_reports(loss)
        self.actor, self.config, self.layout, self.loss = actor, config, layout, loss
        self.epochs, self.minibatches, self.penalty = epochs, minibatches, penalty
        self.optimiser = StackedAdam(actor.learnable, config.lr, config.grad_clip)

    def improve(
        self, rows: PolicyBatch, advantages: Tensor, generators: Sequence[np.random.Generator]
    ) -> dict[str, Tensor]:
        """Update the policies, given advantages (P, B); return metrics, each (P,)."""
        old = None if self.penalty is None else self.penalty.old_policies(self.actor, rows)

        tied = [each for each in (old, rows.start) if each is not None]

        def add_gradients(piece: Piece) -> Tensor:
            return self._add_gradients(piece, rows, advantages, tied)

        schedule = MinibatchSchedule(
            rows.selected, rows.sequences, generators, self.epochs, self.minibatches,
            self.config.piece_samples, self.layout,
        )  # fmt: skip
        compiled = compiled_policy_steps(self.loss, self.actor, self.optimiser, rows, advantages, tied)
        take_steps = compiled or autograd_steps(self.optimiser, add_gradients, len(self.loss.reports))
        reported, norm = take_steps(schedule)
        info = dict(zip(self.loss.reports, reported, strict=True)) | {"gradient_norm": norm}
        if self.penalty is not None and old is not None:
            info |= self.penalty.adapt(self.actor, rows, old)
        if rows.start is not None:
            info["start_kl"] = mean_kl(self.actor, rows, rows.start, self.config.piece_samples)
        return info

    def _add_gradients(
        self, piece: Piece, rows: PolicyBatch, advantages: Tensor, tied: Sequence[OldPolicies]
    ) -> Tensor:
        """Add a piece's gradients by autograd; return its shares of the reported numbers, (I, P)."""
        masks = None if rows.masks is None else piece.of(rows.masks)
        new = self.actor(piece.of(rows.observations), masks, piece.timeline)
        batch = LossRows(piece.of(rows.actions), piece.of(rows.log_probs), piece.of(advantages))
        loss, reported = checked_loss(self.loss, new, batch)
        for old in tied:
            loss = loss + old.penalty(new, self.actor, piece, masks)
        torch.autograd.backward((loss * piece.weight).sum())
        return (reported * piece.weight).sum(2)

    def anneal(self, share: float) -> None:
        """Set the learning rate to `share` of its base."""
        self.optimiser.anneal(share)

    def narrow(self, policies: Tensor) -> Self:
        """Return this update for copies of `policies` (n,)."""
        part = copy(self)
        part.actor = self.actor.narrow(policies)
        part.optimiser = self.optimiser.narrow(policies, part.actor.learnable)
        part.penalty = None if self.penalty is None else self.penalty.narrow(policies)
        return part

    def adopt(self, policies: Tensor, part: Self) -> None:
        """Copy `policies` (n,) and their optimiser state from `part`."""
        self.actor.adopt(policies, part.actor)
        self.optimiser.adopt(policies, part.optimiser)
        if self.penalty is not None and part.penalty is not None:
            self.penalty.adopt(policies, part.penalty)

    def state_dict(self) -> dict[str, Any]:
        """Return the optimiser's state and the penalty's coefficients."""
        state: dict[str, Any] = {"optimiser": self.optimiser.state_dict()}
        return state if self.penalty is None else state | {"kl_coeff": self.penalty.coefficients}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what `state_dict` returned."""
        self.optimiser.load_state_dict(state["optimiser"])
        if self.penalty is not None:
            self.penalty.coefficients = state["kl_coeff"].to(self.layout.device)


def ppo_update(actor: Actor, config: PPOConfig, layout: Layout) -> GradientUpdate:
    """Return PPO: epochs of minibatch steps on the clipped surrogate."""
    penalty = None
    if config.kl_coeff > 0:
        policies = layout.replicas * layout.grouping.num_policies
        coefficients = torch.full((policies,), config.kl_coeff, device=layout.device, dtype=layout.dtype)
        penalty = KLPenalty(coefficients, config.kl_target, config.piece_samples)
    loss = PPOLoss(config.clip, config.entropy_coeff)
    return GradientUpdate(actor, config, layout, loss, config.epochs, config.minibatches, penalty)


def a2c_update(actor: Actor, config: GradientUpdateConfig, layout: Layout) -> GradientUpdate:
    """Return A2C: one step over an iteration's rows."""
    return GradientUpdate(actor, config, layout, A2CLoss(config.entropy_coeff))
