"""ACKTR's update of a stack of policies (Wu et al. 2017, arXiv:1708.05144)."""

from collections.abc import Sequence
from copy import copy
from typing import Any, Self

import numpy as np
import torch
from torch import Tensor

from headway_algos.batches.layout import Layout
from headway_algos.batches.policy_batch import PolicyBatch
from headway_algos.batches.whole_batch import WholeBatch
from headway_algos.networks.actor import Actor
from headway_algos.networks.distributions import Distribution
from headway_algos.networks.linearised import LinearisedMLP
from headway_algos.on_policy.updates.losses import A2CLoss, LossRows
from headway_algos.on_policy.updates.natural_config import KFACConfig
from headway_algos.optim.kfac import StackedKFAC

Before = list[tuple[WholeBatch, Distribution]]
"""Pieces of a batch, with the policies' action distributions before the step."""


class KFAC:
    """One natural-gradient step on E[log pi(u|o) A] + entropy_coeff H over the whole batch (`StackedKFAC`).

    The Fisher information uses actions sampled anew from the policies, one per row; with the actions taken it
    would be the empirical Fisher matrix, which differs (Martens and Grosse 2015, arXiv:1503.05671, section
    5).
    """

    def __init__(self, actor: Actor, config: KFACConfig, layout: Layout) -> None:
        self.actor, self.config, self.loss = actor, config, A2CLoss(config.entropy_coeff)
        self.optimiser = StackedKFAC(actor.network, actor.log_std, config, config.lr, config.kl_bound)

    def improve(
        self, rows: PolicyBatch, advantages: Tensor, generators: Sequence[np.random.Generator]
    ) -> dict[str, Tensor]:
        """Take one step; `generators` sample the actions of the Fisher information.

        Metrics are NaN for policies without rows. `kl` is the mean KL divergence of the step, `predicted_kl`
        its prediction, damping included, and `step` is eta.
        """
        batch = WholeBatch.of(rows, advantages)
        gradient, entropy, before = self._gradient_and_fisher(batch, _noise(batch, generators))
        step = self.optimiser.step(gradient, batch.has_rows.cpu().numpy())
        metrics = {
            "entropy": entropy,
            "gradient_norm": torch.stack([part.square().sum((1, 2)) for part in gradient]).sum(0).sqrt(),
            "kl": self._mean_kl(before, entropy),
            "predicted_kl": step.predicted_kl,
            "step": step.size,
        }
        return {name: batch.where_rows(values) for name, values in metrics.items()}

    def _gradient_and_fisher(self, batch: WholeBatch, noise: Tensor) -> tuple[list[Tensor], Tensor, Before]:
        """Pass the Fisher information to the optimiser; return gradient, entropy and distributions.

        They are the objective's gradient, in the order of the actor's learnable tensors, the mean entropy
        (P,), and the action distributions before the step.
        """
        gradient = [torch.zeros_like(parameter) for parameter in self.actor.learnable]
        mean_entropy = batch.weight.new_zeros(len(batch.weight))
        before: Before = []
        start = 0
        self.optimiser.begin()
        for piece in batch.pieces(self.config.piece_samples):
            end = start + piece.weight.shape[1]
            linear = LinearisedMLP.of(self.optimiser.network, piece.observations)
            of_outputs, *of_log_std = self._derivatives(piece, linear.outputs)
            for total, part in zip(gradient, [*of_log_std, *linear.vjp(of_outputs)], strict=True):
                total += part
            old = self.actor.distribution(linear.outputs, piece.masks).detach()
            mean_entropy += (old.entropy() * piece.weight).sum(1)
            score = old.drawn_score(noise[:, start:end])
            self.optimiser.include(linear, score, old.fisher_of_outputs, piece.weight)
            before.append((piece, old))
            start = end
        return gradient, mean_entropy, before

    def _derivatives(self, piece: WholeBatch, outputs: Tensor) -> Sequence[Tensor]:
        """Return the objective's derivatives in network outputs (P, A, B) and, of a Box, in `log_std`."""
        outputs = outputs.requires_grad_()
        loss, _ = self.loss(
            self.actor.distribution(outputs, piece.masks),
            LossRows(piece.actions, piece.log_probs, piece.advantages),
        )
        inputs = [outputs] if self.actor.log_std is None else [outputs, self.actor.log_std]
        derivatives = torch.autograd.grad(-(loss * piece.weight).sum(), inputs)
        outputs.requires_grad_(False)
        return derivatives

    def _mean_kl(self, before: Before, like: Tensor) -> Tensor:
        total = torch.zeros_like(like)
        with torch.no_grad():
            for piece, old in before:
                new = self.actor(piece.observations, piece.masks)
                total += (new.kl_from(old) * piece.weight).sum(1)
        return total

    def anneal(self, share: float) -> None:
        """Scale steps to `share` of their configured size."""
        self.optimiser.anneal(share)

    def narrow(self, policies: Tensor) -> Self:
        """Return this update for copies of `policies` (n,)."""
        part = copy(self)
        part.actor = self.actor.narrow(policies)
        part.optimiser = self.optimiser.narrow(policies, part.actor.network, part.actor.log_std)
        return part

    def adopt(self, policies: Tensor, part: Self) -> None:
        """Copy `policies` (n,) and their optimiser state from `part`."""
        self.actor.adopt(policies, part.actor)
        self.optimiser.adopt(policies, part.optimiser)

    def state_dict(self) -> dict[str, Any]:
        """Return the optimiser's state."""
        return {"optimiser": self.optimiser.state_dict()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore the result of `state_dict`."""
        self.optimiser.load_state_dict(state["optimiser"])


def _noise(batch: WholeBatch, generators: Sequence[np.random.Generator]) -> Tensor:
    """Draw noise for sampling actions: standard normals (P, W, A) for Box, else uniforms shaped as actions.

    In float64. Each policy's noise comes from its own generator, one draw per row of the policy.
    """
    noise, gaussian = np.zeros(batch.actions.shape), batch.actions.is_floating_point()
    for mine, count, random in zip(noise, (batch.weight > 0).sum(1).tolist(), generators, strict=True):
        mine[:count] = (random.standard_normal if gaussian else random.random)(mine[:count].shape)
    return torch.from_numpy(noise).to(batch.weight.device)
