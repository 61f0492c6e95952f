"""The on-policy learner: critic x update x order, on one stack of policies."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from headway.contracts import EnvSpec, Trajectory, generator
from headway_algos.acting.policy import acting_policy
from headway_algos.agent_id import trajectory_with_ids
from headway_algos.batches.device import resolve_device
from headway_algos.batches.divergence import raise_if_critic_diverged, raise_if_diverged
from headway_algos.batches.hidden_states import HiddenStates
from headway_algos.batches.layout import mean_per_replica
from headway_algos.batches.policy_batch import PolicyBatch, standardise
from headway_algos.batches.policy_stack import PolicyStack
from headway_algos.components import component
from headway_algos.config import AlgoConfig
from headway_algos.grouping import Grouping
from headway_algos.networks.actor import Actor
from headway_algos.networks.gru import RecurrentNetwork
from headway_algos.on_policy.behaviour_policy import BehaviourPolicy
from headway_algos.on_policy.critics import Critic
from headway_algos.on_policy.updates import Update

GPU_PIECE_SAMPLES = 2**20
"""Minimum number of samples per piece on a GPU, which pieces sized for a processor's cache leave idle."""

Order = Callable[
    [Update, Grouping, PolicyBatch, Tensor, Sequence[np.random.Generator], Sequence[np.random.Generator]],
    dict[str, Tensor],
]
"""(update, grouping, rows, advantages (P, B), generators for shuffling (P,), generators for the order (R,))
-> metrics by name, each (P,). Updates the policies in place."""

Improve = Callable[[Trajectory, PolicyBatch, Tensor, int], dict[str, Tensor]]
"""(trajectory, its rows, advantages (P, B), iteration) -> metrics by name, each (P,). Updates policies."""


def simultaneous(
    update: Update,
    grouping: Grouping,
    rows: PolicyBatch,
    advantages: Tensor,
    generators: Sequence[np.random.Generator],
    order_generators: Sequence[np.random.Generator],
) -> dict[str, Tensor]:
    """Update all policies at once, on advantages of the policies that acted."""
    return update.improve(rows, advantages, generators)


class OnPolicyLearner(PolicyStack):
    """A `headway.contracts.Learner` composed of a critic, an update and an order."""

    config: AlgoConfig

    def __init__(
        self,
        config: AlgoConfig,
        spec: EnvSpec,
        seeds: Sequence[int],
        device: str,
        step_scale: float = 1.0,
        unit: str = "iteration",
    ) -> None:
        """`step_scale`: factor on the learning rates; KL bounds are multiplied by its square.

        `unit`: what the numbers passed to `update` count, for error messages.
        """
        if resolve_device(device).type == "cuda":
            config = replace(config, piece_samples=max(config.piece_samples, GPU_PIECE_SAMPLES))
        super().__init__(config, spec, seeds, device)
        self.step_scale, self.unit, spec = step_scale, unit, self.spec
        policies = self.grouping.num_policies
        self.actor = Actor(config.model, spec, seeds, policies, self.dtype).to(self.device)
        self.policy_update: Update = component("update", config.update).make(self.actor, config, self.layout)
        self.critic: Critic = component("critic", config.critic).make(
            config, spec, self.grouping, seeds, self.device, self.dtype
        )
        # Observations of the trajectory include the indices already.
        acting = acting_policy(replace(config, agent_id=False), spec)
        self.behaviour = BehaviourPolicy(config, self.actor, acting, self.layout)

    def acting_parameters(self) -> dict[str, NDArray[Any]]:
        """Return the actor's tensors and normaliser, as named by the acting policy."""
        return self.actor.acting_parameters()

    def update(
        self, trajectory: Trajectory, iteration: int, progress: float
    ) -> dict[str, NDArray[np.float64]]:
        """Compute advantages, then update policies, critic and normalisers, in this order."""
        trajectory = self._drop_unused_slots(trajectory_with_ids(trajectory, self.agent_ids))
        share = self.step_scale * self.config.lr_factor(progress)
        self.policy_update.anneal(share)
        self.critic.anneal(share)
        metrics = self._learn(trajectory, iteration, self._improve_policies)
        # The running statistics apply from the next iteration on.
        self.include_observations(self.actor.moments, trajectory)
        raise_if_diverged(self, self.acting_parameters(), f"{self.unit} {iteration}")
        return metrics

    def _learn(
        self, trajectory: Trajectory, iteration: int, improve: Improve
    ) -> dict[str, NDArray[np.float64]]:
        observations = self._observations(trajectory, self.actor)
        hidden_states = self._hidden_states(trajectory, observations)
        behaviour = replace(self.behaviour, hidden_states=hidden_states)
        estimate = self.critic.estimate(trajectory, behaviour, iteration)
        raise_if_critic_diverged(self, estimate.advantages, f"{self.unit} {iteration}")
        rows = self._policy_batch(trajectory, observations, hidden_states)
        advantages = self.layout.rows(np.broadcast_to(estimate.advantages, trajectory.rewards.shape))
        info = improve(trajectory, rows, advantages, iteration)
        critic_metrics = self.critic.fit(estimate, iteration)
        # Each of these is as large as all observations; the normalisers allocate as much again.
        del observations, hidden_states, estimate, rows, advantages
        self.critic.update_normalisers(trajectory)
        metrics = {f"policy/{name}": mean_per_replica(value, len(self.seeds)) for name, value in info.items()}
        return metrics | {f"critic/{name}": value for name, value in critic_metrics.items()}

    def _drop_unused_slots(self, trajectory: Trajectory) -> Trajectory:
        """Trim trailing slots that were never alive.

        Valid only if agents are exchangeable: one shared policy, no recurrence, and a critic that evaluates
        each agent by itself.
        """
        exchangeable = self.grouping.num_policies == 1 and self.critic.exchangeable_agents
        if not exchangeable or self.config.model.core != "none":
            return trajectory
        used = np.flatnonzero(trajectory.alive.any(axis=(0, 1)))
        return trajectory.of_first_agents(int(used.max(initial=0)) + 1)

    def _observations(self, trajectory: Trajectory, actor: Actor) -> Tensor:
        """Return observations (P, B, D), normalised as by the actor."""
        alive = trajectory.alive[:-1]
        observations = self.layout.rows(trajectory.observations[:-1], alive)
        if self.config.normalise_observations:
            observations = actor.moments.normalised(observations)
        return observations

    def _hidden_states(self, trajectory: Trajectory, observations: Tensor) -> HiddenStates | None:
        """Return the hidden states of recurrent policies along the trajectory, else None."""
        network = self.actor.network
        if not isinstance(network, RecurrentNetwork):
            return None
        begins = np.concatenate([trajectory.begins, trajectory.terminated | trajectory.truncated])
        start, alive = trajectory.hidden_states[0], trajectory.alive[:-1]
        samples = self.config.piece_samples
        return HiddenStates.replay(network, observations, start, begins, alive, self.layout, samples)

    def _policy_batch(
        self, trajectory: Trajectory, observations: Tensor, hidden_states: HiddenStates | None
    ) -> PolicyBatch:
        alive = trajectory.alive[:-1]
        used = alive & trajectory.acting
        selected = self.layout.selection(used)
        masks = None
        if self.spec.has_action_mask:
            # Recurrence may evaluate unused rows too: allow every action there, so that they stay finite.
            masks = self.layout.rows(trajectory.action_masks[:-1] | ~used[..., None])
        return PolicyBatch(
            observations,
            masks,
            self.layout.rows(trajectory.actions, used),
            self.layout.rows(trajectory.log_probs, used),
            selected,
            None
            if hidden_states is None
            else hidden_states.sequences(self.layout, self.config.model.sequence_length),
        )

    def _improve_policies(
        self, trajectory: Trajectory, rows: PolicyBatch, advantages: Tensor, iteration: int
    ) -> dict[str, Tensor]:
        if self.config.normalise_advantages:
            advantages = standardise(advantages, torch.from_numpy(rows.selected).to(self.device))
        generators = self.generators("actor minibatch", iteration)
        order_generators = [generator(seed, "agent order", iteration) for seed in self.seeds]
        improve: Order = component("order", self.config.order).make
        return improve(self.policy_update, self.grouping, rows, advantages, generators, order_generators)

    def state_dict(self) -> dict[str, Any]:
        """Return the states of policies, critic and update."""
        return {
            "actor": self.actor.state_dict(),
            "critic": self.critic.state_dict(),
            "policy_update": self.policy_update.state_dict(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore the result of `state_dict`; raises RuntimeError if shapes differ."""
        self.actor.load_state_dict(state["actor"])
        self.critic.load_state_dict(state["critic"])
        self.policy_update.load_state_dict(state["policy_update"])
