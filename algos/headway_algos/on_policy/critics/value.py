"""State-value critics: V(o) or V(s)."""

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from headway.contracts import Trajectory
from headway_algos.batches.critic_batch import CriticBatch
from headway_algos.batches.hidden_states import HiddenStates
from headway_algos.on_policy.behaviour_policy import BehaviourPolicy
from headway_algos.on_policy.critics.critic_inputs import CentralInputs, LocalInputs
from headway_algos.on_policy.critics.estimate import CriticEstimate
from headway_algos.on_policy.critics.return_regression import RegressionCritic
from headway_algos.on_policy.critics.reward_streams import lambda_advantages, presence


class ValueCritic(RegressionCritic):
    """Stacked value networks with generalised advantage estimation (arXiv:1506.02438).

    If inputs include the other agents' actions, the bootstrap value uses the actions taken at the next step.
    Where none was taken (after the last step, at a final observation), they are sampled once from the
    behaviour policy, so the bootstrap value is unbiased.
    """

    def estimate(self, trajectory: Trajectory, behaviour: BehaviourPolicy, iteration: int) -> CriticEstimate:
        """Estimate values and generalised advantages."""
        random = self.bootstrap_generators(iteration)
        used = presence(trajectory.alive, self.critic_inputs).shape[2]
        # Trailing slots that were never alive may have been left out of the trajectory.
        viewpoints = used if used < self.critic_inputs.viewpoints else None

        def values_of(
            inputs: Tensor, batch: CriticBatch, hidden_states: HiddenStates | None
        ) -> NDArray[np.float64]:
            outputs = self.networks.predict(inputs, batch, hidden_states)
            return self.layout.by_agent(outputs[:, 0], len(batch.observations), viewpoints)

        def value_of(batch: CriticBatch) -> NDArray[np.float64]:
            full = behaviour.with_drawn_actions(batch, random) if self.critic_inputs.needs_actions else batch
            return values_of(self.networks.inputs(*self.networks.rows(full)), full, hidden_states)

        batch = CriticBatch.of_steps(trajectory)
        inputs = self.networks.inputs(*self.networks.rows(batch))
        hidden_states = self.networks.replay(inputs, trajectory)
        values = values_of(inputs, batch, hidden_states)
        advantages, present = lambda_advantages(
            trajectory, self.critic_inputs, values, values, value_of, self.config, self.spec,
            self.layout.replicas,
        )  # fmt: skip
        return CriticEstimate(
            advantages, values, advantages + values, present, inputs, hidden_states=hidden_states
        )


class LocalCritic(ValueCritic):
    """V(o) of an agent's own observation."""

    Inputs = LocalInputs
    exchangeable_agents = True


class CentralCritic(ValueCritic):
    """V(s) of the global state."""

    Inputs = CentralInputs
