"""State-value critics: V(o) or V(s)."""

from collections.abc import Sequence
from typing import Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from headway.contracts import EnvSpec, Trajectory, generator
from headway_algos.batches.critic_batch import CriticBatch
from headway_algos.batches.hidden_states import HiddenStates
from headway_algos.batches.layout import Layout
from headway_algos.grouping import Grouping
from headway_algos.on_policy.behaviour_policy import BehaviourPolicy
from headway_algos.on_policy.critics.config import CriticConfig
from headway_algos.on_policy.critics.critic_inputs import CentralInputs, LocalInputs, MakeInputs
from headway_algos.on_policy.critics.estimate import CriticEstimate
from headway_algos.on_policy.critics.return_regression import ReturnNetworks, ReturnRegression
from headway_algos.on_policy.critics.reward_streams import lambda_advantages, presence


class ValueCritic:
    """Stacked value networks with generalised advantage estimation (arXiv:1506.02438).

    If inputs include the other agents' actions, the bootstrap value uses the actions taken at the next step.
    Where none was taken (after the last step, at a final observation), they are sampled once from the
    behaviour policy, so the bootstrap value is unbiased.
    """

    inputs: ClassVar[MakeInputs]
    """What the critic observes."""
    exchangeable_agents = False

    def __init__(
        self,
        config: CriticConfig,
        spec: EnvSpec,
        grouping: Grouping,
        seeds: Sequence[int],
        device: torch.device,
        dtype: torch.dtype,
    ) -> None:
        self.config, self.spec, self.seeds = config, spec, tuple(seeds)
        self.critic_inputs = self.inputs(config, spec, grouping)
        self.layout = Layout(self.critic_inputs.grouping, len(seeds), device, dtype)
        self.networks = ReturnNetworks(config, self.critic_inputs, 1, seeds, self.layout)
        self.regression = ReturnRegression(config, self.critic_inputs, seeds, self.networks, self.layout)

    def rows(self, batch: CriticBatch) -> Tensor:
        """Return network inputs (P, B, input_size)."""
        indicators = self.critic_inputs.indicators(batch)
        indicator_rows = None if indicators is None else self.layout.rows(indicators)
        return self.networks.inputs(self.layout.rows(self.critic_inputs.features(batch)), indicator_rows)

    def values(
        self, rows: Tensor, points: int, hidden: Tensor | None = None, viewpoints: int | None = None
    ) -> NDArray[np.float64]:
        """Return values (M, C, W), in units of return, for M = `points` time points.

        `rows` (P, B, input_size) are network inputs, `hidden` (P, B, size) the hidden states before them.
        `viewpoints`: W, if the rows contain the first viewpoints only.
        """
        return self.layout.by_agent(self.networks.predict(rows, hidden)[:, 0], points, viewpoints)

    def _hidden(self, batch: CriticBatch, hidden_states: HiddenStates | None) -> Tensor | None:
        """Return the networks' hidden states (P, B, size) at a batch's time points, if recurrent."""
        return None if hidden_states is None else self.layout.rows(batch.select_hidden(hidden_states))

    def estimate(self, trajectory: Trajectory, behaviour: BehaviourPolicy, iteration: int) -> CriticEstimate:
        """Estimate values and generalised advantages."""
        random = [generator(seed, "critic bootstrap actions", iteration) for seed in self.seeds]
        used = presence(trajectory.alive, self.critic_inputs).shape[2]
        viewpoints = used if used < self.critic_inputs.viewpoints else None

        def value_of(batch: CriticBatch) -> NDArray[np.float64]:
            full = behaviour.with_drawn_actions(batch, random) if self.critic_inputs.needs_actions else batch
            points = len(full.observations)
            return self.values(self.rows(full), points, self._hidden(full, hidden_states), viewpoints)

        batch = CriticBatch.of_steps(trajectory)
        inputs = self.rows(batch)
        hidden_states = self.networks.replay(inputs, trajectory, self.critic_inputs, self.layout)
        values = self.values(inputs, len(trajectory.rewards), self._hidden(batch, hidden_states), viewpoints)
        advantages, present = lambda_advantages(
            trajectory,
            self.critic_inputs,
            values,
            values,
            value_of,
            self.config,
            self.spec,
            self.layout.replicas,
        )
        return CriticEstimate(
            advantages, values, advantages + values, present, inputs, hidden_states=hidden_states
        )

    def fit(self, estimate: CriticEstimate, iteration: int) -> dict[str, NDArray[np.float64]]:
        """Train the value networks on the estimated returns."""
        return self.regression.fit(estimate, iteration)

    def update_normalisers(self, trajectory: Trajectory) -> None:
        """Include an iteration's inputs in the running statistics."""
        self.regression.update_normalisers(trajectory)

    def anneal(self, share: float) -> None:
        """Set the learning rate to `share` of its configured value."""
        self.regression.anneal(share)

    def state_dict(self) -> dict[str, Any]:
        """Return the states of networks, normalisers and optimiser."""
        return self.regression.state_dict()

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore the result of `state_dict`; raises RuntimeError if shapes differ."""
        self.regression.load_state_dict(state)


class LocalCritic(ValueCritic):
    """V(o) of an agent's own observation."""

    inputs = LocalInputs
    exchangeable_agents = True


class CentralCritic(ValueCritic):
    """V(s) of the global state."""

    inputs = CentralInputs
