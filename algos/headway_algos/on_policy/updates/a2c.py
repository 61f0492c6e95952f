"""Advantage actor-critic update of a stack of policies (Mnih et al. 2016, arXiv:1602.01783)."""

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
from headway_algos.networks.passes import forward_pass
from headway_algos.optim.adam import StackedAdam


class A2C:
    """One gradient step on -E[log pi(u|o) A] - entropy_coeff H over the whole batch.

    `epochs` and `minibatches` apply to the critic only. The gradient is accumulated over pieces that fit the
    cache.
    """

    def __init__(self, actor: Actor, config: AlgoConfig, layout: Layout) -> None:
        self.actor, self.config = actor, config
        self.optimiser = StackedAdam(actor.learnable, config.lr, config.grad_clip)

    def improve(
        self, rows: PolicyBatch, advantages: Tensor, generators: Sequence[np.random.Generator]
    ) -> dict[str, Tensor]:
        """Take one gradient step; `generators` are not used."""
        batch = WholeBatch.of(rows, advantages)
        mean_entropy = torch.zeros(len(advantages), device=advantages.device, dtype=advantages.dtype)
        self.optimiser.begin()
        for piece in batch.pieces(self.config.piece_samples):
            passed = forward_pass(self.actor.network, piece.observations, piece.timeline)
            with torch.no_grad():
                distribution = self.actor.distribution(passed.outputs, piece.masks)
                of_log_prob = -piece.weight * piece.advantages
                of_entropy = -self.config.entropy_coeff * piece.weight
                slopes = distribution.slopes(piece.actions, of_log_prob, of_entropy)
                self.actor.send_back(passed, slopes)
                mean_entropy += (distribution.entropy() * piece.weight).sum(1)
        norm = self.optimiser.step(batch.has_rows.cpu().numpy())
        return {"entropy": mean_entropy, "gradient_norm": norm}

    def anneal(self, share: float) -> None:
        """Set the learning rate to `share` of its configured value."""
        self.optimiser.anneal(share)

    def narrow(self, policies: Tensor) -> Self:
        """Return this update for copies of `policies` (n,)."""
        part = copy(self)
        part.actor = self.actor.narrow(policies)
        part.optimiser = self.optimiser.narrow(policies, part.actor.learnable)
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
