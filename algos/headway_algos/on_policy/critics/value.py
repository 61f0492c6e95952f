"""Critics that value what they see: V(o) or V(s)."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from headway.contracts import EnvSpec, Trajectory, generator
from headway_algos.batches.critic_batch import CriticBatch
from headway_algos.batches.hidden_states import HiddenStates
from headway_algos.batches.layout import Layout
from headway_algos.config import AlgoConfig
from headway_algos.grouping import Grouping
from headway_algos.on_policy.behaviour_policy import BehaviourPolicy
from headway_algos.on_policy.critics.critic_inputs import VIEWS
from headway_algos.on_policy.critics.estimate import CriticEstimate
from headway_algos.on_policy.critics.return_regression import ReturnNetworks, ReturnRegression
from headway_algos.on_policy.critics.reward_streams import lambda_advantages, presence


class ValueCritic:
    """A stack of value networks over one view; advantages are generalised ones (arXiv:1506.02438).

    A view that shows the others' actions is bootstrapped with the actions taken at the next step. Where
    none was taken (after the last step, at a final observation) they are drawn once from the policies that
    acted, as a worker would have: the mean over such draws is what that next action would have given.
    """

    def __init__(
        self,
        config: AlgoConfig,
        spec: EnvSpec,
        grouping: Grouping,
        seeds: Sequence[int],
        device: torch.device,
        dtype: torch.dtype,
    ) -> None:
        self.config, self.spec, self.seeds = config, spec, tuple(seeds)
        self.view = VIEWS[config.critic](config, spec, grouping)
        self.layout = Layout(self.view.grouping, len(seeds), device, dtype)
        self.networks = ReturnNetworks(config, self.view, 1, seeds, self.layout)
        self.regression = ReturnRegression(config, self.view, seeds, self.networks, self.layout)

    def rows(self, batch: CriticBatch) -> Tensor:
        """Network inputs (P, B, input_size)."""
        indicators = self.view.indicators(batch)
        shown = None if indicators is None else self.layout.rows(indicators)
        return self.networks.inputs(self.layout.rows(self.view.features(batch)), shown)

    def values(
        self, rows: Tensor, moments: int, hidden: Tensor | None = None, viewpoints: int | None = None
    ) -> NDArray[np.float64]:
        """Values (M, C, W), in units of return, of network inputs and what is remembered before them;
        `viewpoints`: W, where it is fewer than all."""
        return self.layout.by_agent(self.networks.predict(rows, hidden)[:, 0], moments, viewpoints)

    def _memory(self, batch: CriticBatch, hidden_states: HiddenStates | None) -> Tensor | None:
        """(P, B, M): what the networks remembered at the moments of a scene, if they do."""
        return None if hidden_states is None else self.layout.rows(batch.select_hidden(hidden_states))

    def estimate(self, trajectory: Trajectory, behaviour: BehaviourPolicy, iteration: int) -> CriticEstimate:
        """See `headway_algos.on_policy.critics.Critic`."""
        random = [generator(seed, "critic bootstrap actions", iteration) for seed in self.seeds]
        there = presence(trajectory.alive, self.view).shape[2]
        viewpoints = there if there < self.view.viewpoints else None

        def value_of(batch: CriticBatch) -> NDArray[np.float64]:
            shown = behaviour.with_drawn_actions(batch, random) if self.view.needs_actions else batch
            moments = len(shown.observations)
            return self.values(self.rows(shown), moments, self._memory(shown, hidden_states), viewpoints)

        batch = CriticBatch.of_steps(trajectory)
        inputs = self.rows(batch)
        hidden_states = self.networks.replay(inputs, trajectory, self.view, self.layout)
        values = self.values(inputs, len(trajectory.rewards), self._memory(batch, hidden_states), viewpoints)
        advantages, present = lambda_advantages(
            trajectory, self.view, values, value_of, self.config, self.spec, self.layout.replicas
        )
        return CriticEstimate(
            advantages, values, advantages + values, present, inputs, hidden_states=hidden_states
        )

    def fit(self, estimate: CriticEstimate, iteration: int) -> dict[str, NDArray[np.float64]]:
        """See `headway_algos.on_policy.critics.Critic`."""
        return self.regression.fit(estimate, iteration)

    def update_normalisers(self, trajectory: Trajectory) -> None:
        """See `headway_algos.on_policy.critics.Critic`."""
        self.regression.update_normalisers(trajectory)

    def anneal(self, share: float) -> None:
        """Set the learning rate to `share` of its base."""
        self.regression.anneal(share)

    def state_dict(self) -> dict[str, Any]:
        """Networks, normalisers and the optimiser."""
        return self.regression.state_dict()

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Inverse of `state_dict`; raises RuntimeError where shapes differ."""
        self.regression.load_state_dict(state)
