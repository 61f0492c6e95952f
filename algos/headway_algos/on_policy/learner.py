"""The on-policy learner: a critic, an update and an order, over one stack of policies."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from headway.contracts import EnvSpec, HeadwayError, Trajectory, generator
from headway_algos.acting.gru import acting_policy
from headway_algos.batches.hidden_states import HiddenStates
from headway_algos.batches.layout import Layout
from headway_algos.batches.policy_batch import PolicyBatch, standardise
from headway_algos.batches.policy_stack import Stack, resolve_device
from headway_algos.config import AlgoConfig
from headway_algos.grouping import Grouping
from headway_algos.networks.actor import Actor
from headway_algos.networks.gru import RecurrentNetwork
from headway_algos.on_policy.behaviour_policy import BehaviourPolicy
from headway_algos.on_policy.critics import CRITICS, Critic
from headway_algos.on_policy.orders import ORDERS
from headway_algos.on_policy.updates import UPDATES


class OnPolicyLearner:
    """Experience in, better parameters out: critic x update x order (see `headway.contracts.Learner`)."""

    def __init__(self, config: AlgoConfig, spec: EnvSpec, seeds: Sequence[int], device: str) -> None:
        self.config, self.spec, self.seeds = config, spec, tuple(seeds)
        self.device, self.dtype = resolve_device(device), getattr(torch, config.precision)
        self.grouping = Grouping.of(config.policies, spec)
        self.stack = Stack(self.grouping, spec, self.seeds)
        self.layout = Layout(self.grouping, len(seeds), self.device, self.dtype)
        policies = self.grouping.num_policies
        self.actor = Actor(config.model, spec, seeds, policies, self.dtype).to(self.device)
        self.policy_update = UPDATES[config.update](self.actor, config, self.layout)
        self.critic: Critic = CRITICS[config.critic](
            config, spec, self.grouping, seeds, self.device, self.dtype
        )
        self.behaviour = BehaviourPolicy(config, self.actor, acting_policy(config, spec), self.layout)

    def acting_parameters(self) -> dict[str, NDArray[Any]]:
        """The actor's tensors and its normaliser, by the names of the acting policy."""
        return self.actor.acting_parameters()

    def update(
        self, trajectory: Trajectory, iteration: int, progress: float
    ) -> dict[str, NDArray[np.float64]]:
        """One iteration of learning: advantages, policies, critic, normalisers, in this order."""
        trajectory = self._drop_unused_slots(trajectory)
        share = 1 - (1 - self.config.lr_end) * progress
        self.policy_update.anneal(share)
        self.critic.anneal(share)
        observations = self._observations(trajectory)
        hidden_states = self._hidden_states(trajectory, observations)
        estimate = self.critic.estimate(
            trajectory, self.behaviour.with_hidden_states(hidden_states), iteration
        )
        self._raise_if_critic_diverged(estimate.advantages, iteration)
        info = self._improve_policies(trajectory, observations, hidden_states, estimate.advantages, iteration)
        critic_metrics = self.critic.fit(estimate, iteration)
        # Each is as large as all that was observed, and so is what the normalisers need next.
        del observations, hidden_states, estimate
        self._update_normalisers(trajectory)
        self.stack.raise_if_diverged(
            self.acting_parameters(), self.config.name, iteration, "lower algo.lr and algo.critic_lr"
        )
        metrics = {f"policy/{name}": self.stack.per_replica(value) for name, value in info.items()}
        return metrics | {f"critic/{name}": value for name, value in critic_metrics.items()}

    def _drop_unused_slots(self, trajectory: Trajectory) -> Trajectory:
        """Without the last agents, as far as these were never there, where nobody can tell: agents that
        share policy and critic, each of which sees but itself, and remembers nothing. Slots of an environment
        with room for many are mostly empty."""
        alike = self.config.policies == "shared" and self.config.critic == "local"
        if not alike or self.config.model.core != "none":
            return trajectory
        there = np.flatnonzero(trajectory.alive.any(axis=(0, 1)))
        return trajectory.of_first_agents(int(there.max(initial=0)) + 1)

    def _observations(self, trajectory: Trajectory) -> Tensor:
        """(P, B, D), as the policies' networks were given them."""
        alive = trajectory.alive[:-1]
        observations = self.layout.rows(trajectory.observations[:-1], alive)
        if self.config.normalise_observations:
            observations = self.actor.moments.normalised(observations)
        return observations

    def _hidden_states(self, trajectory: Trajectory, observations: Tensor) -> HiddenStates | None:
        """What policies that remember did, as they acted."""
        network = self.actor.network
        if not isinstance(network, RecurrentNetwork):
            return None
        begins = np.concatenate([trajectory.begins, trajectory.terminated | trajectory.truncated])
        start, alive = trajectory.hidden_states[0], trajectory.alive[:-1]
        samples = self.config.piece_samples
        return HiddenStates.replay(network, observations, start, begins, alive, self.layout, samples)

    def _improve_policies(
        self,
        trajectory: Trajectory,
        observations: Tensor,
        hidden_states: HiddenStates | None,
        advantages: NDArray[np.float64],
        iteration: int,
    ) -> dict[str, Tensor]:
        alive = trajectory.alive[:-1]
        used = alive & trajectory.acting
        selected = self.layout.selection(used)
        masks = None
        if self.spec.has_action_mask:
            # Rows that only lead up to others may have to be evaluated, too: they must stay finite.
            masks = self.layout.rows(trajectory.action_masks[:-1] | ~used[..., None])
        rows = PolicyBatch(
            observations,
            masks,
            self.layout.rows(trajectory.actions, used),
            self.layout.rows(trajectory.log_probs, used),
            selected,
            None
            if hidden_states is None
            else hidden_states.sequences(self.layout, self.config.model.sequence_length),
        )
        by_policy = self.layout.rows(np.broadcast_to(advantages, alive.shape))
        if self.config.normalise_advantages:
            by_policy = standardise(by_policy, torch.from_numpy(selected).to(self.device))
        generators = self._generators("actor minibatch", iteration)
        in_order = [generator(seed, "agent order", iteration) for seed in self.seeds]
        return ORDERS[self.config.order](
            self.policy_update, self.grouping, rows, by_policy, generators, in_order
        )

    def _update_normalisers(self, trajectory: Trajectory) -> None:
        """Update the normalisers from this iteration; they act from the next one on."""
        self.critic.update_normalisers(trajectory)
        if self.config.normalise_observations:
            alive = trajectory.alive[:-1]
            rows = self.layout.rows(trajectory.observations[:-1], alive)
            self.actor.moments.include(rows, self.layout.selection(alive))

    def _raise_if_critic_diverged(self, advantages: NDArray[np.float64], iteration: int) -> None:
        """Raise HeadwayError where advantages (T, C, W) are not finite: a trust region would stay put on
        them, and training go on for nothing."""
        broken = np.argwhere(~np.isfinite(advantages))
        if len(broken):
            seed = self.seeds[broken[:, 1].min() * len(self.seeds) // advantages.shape[1]]
            raise HeadwayError(
                f"{self.config.name} diverged: the critic of seed {seed} gives values that are not finite at "
                f"iteration {iteration}; lower algo.critic_lr, or bound the gradients by algo.grad_clip"
            )

    def _generators(self, purpose: str, iteration: int) -> list[np.random.Generator]:
        policies = range(self.grouping.num_policies)
        return [generator(seed, purpose, k, iteration) for seed in self.seeds for k in policies]

    def state_dict(self) -> dict[str, Any]:
        """The policies, and all that the update and the critic carry on."""
        return {
            "actor": self.actor.state_dict(),
            "critic": self.critic.state_dict(),
            "policy_update": self.policy_update.state_dict(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Inverse of `state_dict`; raises RuntimeError where shapes differ."""
        self.actor.load_state_dict(state["actor"])
        self.critic.load_state_dict(state["critic"])
        self.policy_update.load_state_dict(state["policy_update"])
