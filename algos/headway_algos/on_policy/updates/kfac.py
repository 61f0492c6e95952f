"""The actor's step of ACKTR (Wu et al. 2017, arXiv:1708.05144), for a stack of policies."""

from collections.abc import Sequence
from copy import copy
from typing import Any, Self

import numpy as np
import torch
from torch import Tensor

from headway_algos.batches.layout import Layout
from headway_algos.batches.policy_batch import PolicyBatch
from headway_algos.batches.whole_batch import WholeBatch
from headway_algos.config import AlgoConfig
from headway_algos.networks.actor import Actor
from headway_algos.networks.distributions import Distribution
from headway_algos.networks.linearised import LinearisedMLP
from headway_algos.on_policy.updates.a2c import A2C
from headway_algos.on_policy.updates.policy_loss import Minibatch
from headway_algos.optim.kfac import StackedKFAC

Before = list[tuple[WholeBatch, Distribution]]
"""Pieces of a batch, and what the policies did there."""


class KFAC:
    """One step along the natural gradient of E[log pi(u|o) A] + entropy_coeff H, over all of an iteration's
    rows, as far as `lr` and the trust region allow (see `StackedKFAC`).

    The Fisher information is of actions drawn anew from the policies, one a row: those that were taken would
    give another matrix, the empirical one (Martens and Grosse, section 5). Always one step: `epochs` and
    `minibatches` are the critic's alone.
    """

    def __init__(self, actor: Actor, config: AlgoConfig, layout: Layout) -> None:
        self.actor, self.config, self.loss = actor, config, A2C(config.entropy_coeff)
        self.optimiser = StackedKFAC(actor.network, actor.log_std, config, config.lr, config.kl_bound)

    def improve(
        self, rows: PolicyBatch, advantages: Tensor, generators: Sequence[np.random.Generator]
    ) -> dict[str, Tensor]:
        """See `headway_algos.on_policy.updates.Update`; the generators draw the Fisher information's actions.

        `kl` is the mean KL divergence that the step came to, `predicted_kl` what it was expected to be,
        damping included, and `step` its eta."""
        batch = WholeBatch.of(rows, advantages)
        gradient, entropy, before = self._look(batch, _noise(batch, generators))
        step = self.optimiser.step(gradient, batch.has_rows.cpu().numpy())
        return {
            "entropy": entropy,
            "gradient_norm": torch.stack([part.square().sum((1, 2)) for part in gradient]).sum(0).sqrt(),
            "kl": self._mean_kl(before, entropy),
            "predicted_kl": step.predicted_kl,
            "step": step.size,
        }

    def _look(self, batch: WholeBatch, noise: Tensor) -> tuple[list[Tensor], Tensor, Before]:
        """The objective's gradient, in the order of the actor's learnable tensors, and the mean entropy (P,);
        the Fisher information goes to the optimiser."""
        gradient = [torch.zeros_like(parameter) for parameter in self.actor.learnable]
        mean_entropy = batch.weight.new_zeros(len(batch.weight))
        before: Before = []
        start = 0
        self.optimiser.begin()
        for piece in batch.pieces(self.config.piece_samples):
            end = start + piece.weight.shape[1]
            linear = LinearisedMLP.of(self.optimiser.network, piece.observations)
            of_outputs, *of_log_std = self._derivatives(piece, linear.outputs)
            for total, part in zip(gradient, [*of_log_std, *linear.pull(of_outputs)], strict=True):
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
            Minibatch(piece.actions, piece.log_probs, piece.advantages),
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
        """Take steps of `share` of their length from now on."""
        self.optimiser.anneal(share)

    def narrow(self, policies: Tensor) -> Self:
        """See `headway_algos.on_policy.updates.Update`."""
        part = copy(self)
        part.actor = self.actor.narrow(policies)
        part.optimiser = self.optimiser.narrow(policies, part.actor.network, part.actor.log_std)
        return part

    def adopt(self, policies: Tensor, part: Self) -> None:
        """See `headway_algos.on_policy.updates.Update`."""
        self.actor.adopt(policies, part.actor)
        self.optimiser.adopt(policies, part.optimiser)

    def state_dict(self) -> dict[str, Any]:
        """The optimiser."""
        return {"optimiser": self.optimiser.state_dict()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Inverse of `state_dict`."""
        self.optimiser.load_state_dict(state["optimiser"])


def _noise(batch: WholeBatch, generators: Sequence[np.random.Generator]) -> Tensor:
    """What actions are drawn by, in the shape of actions, (P, W) or (P, W, A), in float64: uniforms for
    Discrete ones, else standard normals. A policy draws as many as it has rows, with its own generator."""
    noise = np.zeros(batch.actions.shape)
    for mine, count, random in zip(noise, (batch.weight > 0).sum(1).tolist(), generators, strict=True):
        if mine.ndim == 1:
            mine[:count] = random.random(count)
        else:
            mine[:count] = random.standard_normal((count, mine.shape[1]))
    return torch.from_numpy(noise).to(batch.weight.device)
