"""Deterministic policy gradients on stacked actors and critics (Lillicrap et al. 2016, arXiv:1509.02971)."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from headway.contracts import Box, EnvSpec
from headway_algos.networks.mlp import StackedMLP
from headway_algos.off_policy.learner import Method
from headway_algos.off_policy.replay_buffer import Batch
from headway_algos.off_policy.target_networks import (
    TargetNetwork,
    mean_over_batch,
    regression_loss,
    temporal_difference_target,
)
from headway_algos.optim.adam import StackedAdam
from headway_algos.replay_config import DDPGConfig

ACTOR_GAIN = 0.01
"""Gain of the actor's last layer, so that initial actions are near mid-range (the paper's section 7)."""


class DeterministicPolicyGradient(Method):
    """Actors mu(o) and critics Q(o, u) with target networks.

    Networks work with actions scaled to [-1, 1], and with 0 in a dimension whose bounds are equal.
    """

    def __init__(
        self, config: DDPGConfig, spec: EnvSpec, seeds: Sequence[int], policies: int, device: torch.device
    ) -> None:
        self.config = config
        model, dtype = config.model, getattr(torch, config.precision)
        box = spec.action_space
        assert isinstance(box, Box)
        low, high = (torch.tensor(bound, dtype=dtype, device=device) for bound in (box.low, box.high))
        self.middle, half = (low + high) / 2, (high - low) / 2
        self.half = torch.where(half > 0, half, 1)
        self.free = (half > 0).to(dtype)
        """(A,): 0 for action components with equal bounds, else 1."""
        size, form = spec.observation_size, model.activation
        self.network = StackedMLP(
            seeds, policies, "actor", (size, model.hidden, box.size), form, ACTOR_GAIN, dtype
        ).to(device)
        self.critic = StackedMLP(
            seeds, policies, "critic", (size + box.size, model.hidden, 1), form, 1.0, dtype
        ).to(device)
        self.target_actor = TargetNetwork(self.network, config.target_every, config.tau)
        self.target_critic = TargetNetwork(self.critic, config.target_every, config.tau)
        self.actor_optimiser = StackedAdam(self.network.parameters(), config.lr, config.grad_clip)
        self.critic_optimiser = StackedAdam(
            self.critic.parameters(), config.critic_lr or config.lr, config.grad_clip
        )

    def targets(self, batch: Batch) -> Tensor:
        """Return y = G + gamma^k Q'(o', mu'(o')), (P, b)."""
        with torch.no_grad():
            then = batch.next_observations
            actions = _bounded(self._outputs(self.target_actor.network, then))
            next_values = _values(self.target_critic.network, then, actions)
            return temporal_difference_target(batch.returns, batch.discounts, next_values)

    def learn(self, batch: Batch, active: NDArray[np.bool_]) -> dict[str, Tensor]:
        """Take one gradient step of critics and actors, and update the target networks if due."""
        targets, taken = self.targets(batch), (batch.actions - self.middle) / self.half * self.free
        values = _values(self.critic, batch.observations, taken)
        loss = mean_over_batch(regression_loss(values - targets, self.config.loss), active)
        self.critic_optimiser.begin()
        torch.autograd.backward(loss.sum())
        critic_norm = self.critic_optimiser.step(active)
        actor_norm = self._improve_actors(batch.observations, active)
        self.target_actor.follow(active, self.actor_optimiser.counts)
        self.target_critic.follow(active, self.critic_optimiser.counts)
        return {
            "critic/loss": loss.detach(),
            "critic/value": mean_over_batch(values, active).detach(),
            "critic/gradient_norm": critic_norm,
            "policy/gradient_norm": actor_norm,
        }

    def _improve_actors(self, observations: Tensor, active: NDArray[np.bool_]) -> Tensor:
        """Ascend E[dQ/du(o, u = mu(o)) dmu/dtheta(o)], minus the saturation penalty on the inputs of tanh.

        Returns gradient norms (P,).
        """
        outputs = self._outputs(self.network, observations)
        actions = _bounded(outputs)
        leaf_actions = actions.detach().requires_grad_()
        (gradients,) = torch.autograd.grad(
            _values(self.critic, observations, leaf_actions).sum(), leaf_actions
        )
        self.actor_optimiser.begin()
        batch = gradients.shape[1]
        penalty_gradients = 2 * self.config.saturation_coeff * outputs.detach() / batch
        torch.autograd.backward([actions, outputs], [-gradients / batch, penalty_gradients])
        return self.actor_optimiser.step(active)

    def _outputs(self, actor: StackedMLP, observations: Tensor) -> Tensor:
        """Return the network outputs (P, A, b), before the tanh of mu(o)."""
        outputs: Tensor = actor(observations)
        return outputs * self.free[:, None]

    def anneal(self, share: float) -> None:
        """Set the learning rates to `share` of their configured values."""
        self.actor_optimiser.anneal(share)
        self.critic_optimiser.anneal(share)

    @property
    def parts(self) -> dict[str, Any]:
        """Actors, critics, their target networks and optimisers."""
        return {
            "actor": self.network, "critic": self.critic,
            "slow_actor": self.target_actor.network, "slow_critic": self.target_critic.network,
            "actor_optimiser": self.actor_optimiser, "critic_optimiser": self.critic_optimiser,
        }  # fmt: skip


def _bounded(outputs: Tensor) -> Tensor:
    """Squash network outputs (P, A, b) to actions (P, b, A) in [-1, 1]."""
    return outputs.tanh().transpose(1, 2)


def _values(critic: StackedMLP, observations: Tensor, actions: Tensor) -> Tensor:
    """Return Q(o, u), (P, b)."""
    outputs: Tensor = critic(torch.cat([observations, actions], dim=2))
    return outputs[:, 0]
