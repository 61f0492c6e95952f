"""Deep Q-learning on a stack of networks (Mnih et al. 2015, doi 10.1038/nature14236).

Double Q-learning: van Hasselt et al. 2016, arXiv:1509.06461.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from headway.contracts import EnvSpec
from headway_algos.acting.mlp import actor_outputs
from headway_algos.networks.mlp import StackedMLP
from headway_algos.off_policy.learner import Method
from headway_algos.off_policy.replay_buffer import Batch
from headway_algos.off_policy.target_networks import (
    TargetNetwork,
    best_allowed,
    mean_over_batch,
    regression_loss,
    temporal_difference_target,
)
from headway_algos.optim.adam import StackedAdam
from headway_algos.replay_config import MADQNConfig


class QLearning(Method):
    """Networks Q(o, .) and their target networks."""

    def __init__(
        self, config: MADQNConfig, spec: EnvSpec, seeds: Sequence[int], policies: int, device: torch.device
    ) -> None:
        self.config = config
        model, dtype = config.model, getattr(torch, config.precision)
        sizes = (spec.observation_size, model.hidden, actor_outputs(spec))
        self.network = StackedMLP(seeds, policies, "q network", sizes, model.activation, 1.0, dtype).to(
            device
        )
        self.target = TargetNetwork(self.network, config.target_every, config.tau)
        self.optimiser = StackedAdam(self.network.parameters(), config.lr, config.grad_clip)

    def targets(self, batch: Batch) -> Tensor:
        """Return y = G + gamma^k Q'(o', u), (P, b); u is the best allowed action by Q (double) or by Q'."""
        with torch.no_grad():
            target_values = self.target.network(batch.next_observations)
            ranking = self.network(batch.next_observations) if self.config.double else target_values
            best = best_allowed(ranking, batch.next_masks)
            next_values = target_values.gather(1, best[:, None])[:, 0]
            return temporal_difference_target(batch.returns, batch.discounts, next_values)

    def learn(self, batch: Batch, active: NDArray[np.bool_]) -> dict[str, Tensor]:
        """Take one gradient step on the mean loss of Q(o, u) - y over each policy's batch."""
        targets = self.targets(batch)
        values = self.network(batch.observations).gather(1, batch.actions[:, None])[:, 0]
        loss = mean_over_batch(regression_loss(values - targets, self.config.loss), active)
        self.optimiser.begin()
        torch.autograd.backward(loss.sum())
        norm = self.optimiser.step(active)
        self.target.follow(active, self.optimiser.counts)
        value = mean_over_batch(values, active)
        return {"critic/loss": loss.detach(), "critic/value": value.detach(), "critic/gradient_norm": norm}

    def anneal(self, share: float) -> None:
        """Set the learning rate to `share` of its configured value."""
        self.optimiser.anneal(share)

    @property
    def parts(self) -> dict[str, Any]:
        """Network, target network and optimiser."""
        return {"network": self.network, "target": self.target.network, "optimiser": self.optimiser}
