"""Starts of the on-policy learner from a rule or a trained run."""

from dataclasses import replace
from functools import cached_property, partial
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from headway.contracts import Trajectory
from headway_algos.agent_id import trajectory_with_ids
from headway_algos.batches.divergence import raise_if_diverged
from headway_algos.batches.nested_states import replica_state, same_shapes, trained_state
from headway_algos.batches.old_policies import OldPolicies
from headway_algos.batches.policy_batch import PolicyBatch
from headway_algos.grouping import Grouping
from headway_algos.networks.actor import Actor
from headway_algos.on_policy.imitation import decisions, imitate, imitate_sequences
from headway_algos.on_policy.learner import OnPolicyLearner
from headway_algos.on_policy.rule_decisions import RuleDecisions

_NETWORKS = ("networks", "target", "events_networks")
"""Parts of a critic's state that another run can start from: networks with their normalisers."""


class WarmStartLearner(OnPolicyLearner):
    """A `headway.contracts.AnchoredLearner`: an on-policy learner that can start from a rule or a run."""

    start_actor: Actor | None = None
    """Policies with which training started, while a penalty keeps the new ones near them."""
    kl_coeff, critic_only = 0.0, False

    @cached_property
    def rule_decisions(self) -> RuleDecisions:
        """The rule's decisions that are kept until the policies imitate them."""
        return RuleDecisions(len(self.seeds), self.grouping.num_policies, self.spec.observation_size)

    def anchor(self, kl_coeff: float, critic_only: bool) -> None:
        """Implement `headway.contracts.AnchoredLearner.anchor`."""
        self.kl_coeff, self.critic_only = kl_coeff, critic_only
        if kl_coeff > 0 and self.start_actor is None:
            self.start_actor = self._copy_of_actor()

    def _copy_of_actor(self) -> Actor:
        return self.actor.narrow(
            torch.arange(len(self.seeds) * self.grouping.num_policies, device=self.device)
        )

    def imitate(
        self, trajectory: Trajectory, iteration: int, iterations: int
    ) -> dict[str, NDArray[np.float64]]:
        """Train the critic on the rule's returns; let the policies learn its decisions.

        Recurrent policies learn in each iteration from its rows; others learn in the last one, from a sample
        of all iterations.
        """
        trajectory = self._drop_unused_slots(trajectory_with_ids(trajectory, self.agent_ids))
        self.critic.anneal(self.step_scale)
        # First, so that policies learn on observations that are normalised as in the next iteration.
        self.include_observations(self.actor.moments, trajectory)
        metrics = self._learn(trajectory, iteration, partial(self._imitate, iterations))
        raise_if_diverged(self, self.acting_parameters(), f"{self.unit} {iteration}")
        return metrics

    def _improve_policies(
        self, trajectory: Trajectory, rows: PolicyBatch, advantages: Tensor, iteration: int
    ) -> dict[str, Tensor]:
        if self.critic_only:
            return {}
        rows = replace(rows, start=self._start_policies(trajectory))
        return super()._improve_policies(trajectory, rows, advantages, iteration)

    def _start_policies(self, trajectory: Trajectory) -> OldPolicies | None:
        """Return the start policies in the states of a trajectory; None if no penalty needs them."""
        if self.start_actor is None or self.kl_coeff == 0:
            return None
        observations = self._observations(trajectory, self.start_actor)
        coefficients = observations.new_full((len(observations),), self.kl_coeff)
        return OldPolicies.of(self.start_actor, observations, None, coefficients, self.config.piece_samples)

    def _imitate(
        self, iterations: int, trajectory: Trajectory, rows: PolicyBatch, advantages: Tensor, iteration: int
    ) -> dict[str, Tensor]:
        generators = self.generators("actor minibatch", iteration)
        rows, parts = decisions(rows, self.actor.nvec), (self.config, self.layout, generators)
        if rows.sequences is not None:
            share = 1 - (iteration - 1) / iterations
            return imitate_sequences(self.actor, rows, *parts, share)
        observed = self.layout.rows(trajectory.observations[:-1], trajectory.alive[:-1])
        self.rule_decisions.include(replace(rows, observations=observed), generators)
        if iteration < iterations:
            return {}
        alike, moments = self._alike(), None
        if self.config.normalise_observations:
            moments = self.actor.moments
            # Policies that learn together must see an observation alike.
            moments.pool(alike.policies(len(self.seeds), len(self.seeds)).ravel())
        sample = self.rule_decisions.rows(moments, self.device)
        del self.rule_decisions  # the next access would begin a new, empty sample
        return imitate(self.actor, sample, *parts, alike)

    def _alike(self) -> Grouping:
        """Return the policies of a seed grouped by whether their agents are interchangeable."""
        if self.config.policies == "independent":
            return Grouping.of("groups", self.spec)
        return Grouping(np.arange(self.grouping.num_policies)[:, None])

    def replay_state(self) -> dict[str, Any] | None:
        """Return the rule's decisions that are kept for imitation; None if there are none."""
        kept = self.rule_decisions.kept
        return {"rule_decisions": kept} if any(kept) else None

    def load_replay_state(self, state: dict[str, Any]) -> None:
        """Continue from the result of `replay_state`."""
        self.rule_decisions.kept = list(state["rule_decisions"])

    def start_from(self, state: dict[str, Any], replica: int, replicas: int, with_critic: bool) -> list[str]:
        """Implement `headway.contracts.StartingLearner.start_from`."""
        parent = replica_state(trained_state(state), replica, replicas, len(self.seeds))
        self.actor.load_state_dict(parent["actor"])
        if not with_critic:
            return []
        own = self.critic.state_dict()
        networks = {name: own[name] for name in _NETWORKS if name in own}
        taken = {name: part for name, part in parent["critic"].items() if name in _NETWORKS}
        if not same_shapes(taken, networks):
            return ["the critic of start.run does not fit this environment: a new one is trained"]
        self.critic.load_state_dict({**own, **taken})
        return []

    def state_dict(self) -> dict[str, Any]:
        """Return the learner's state, with the start policies if a penalty uses them."""
        start = {} if self.start_actor is None else {"start": self.start_actor.state_dict()}
        return super().state_dict() | start

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore the result of `state_dict`; raises RuntimeError if shapes differ."""
        super().load_state_dict(state)
        if "start" in state:
            self.start_actor = self._copy_of_actor()
            self.start_actor.load_state_dict(state["start"])
