"""COMA's critic: what would have come of other actions (Foerster et al. 2018, arXiv:1705.08926)."""

from collections.abc import Sequence
from copy import deepcopy
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from headway.contracts import Discrete, EnvSpec, Trajectory, generator
from headway_algos.batches.critic_batch import CriticBatch
from headway_algos.batches.hidden_states import HiddenStates
from headway_algos.batches.layout import Layout
from headway_algos.config import AlgoConfig
from headway_algos.grouping import Grouping
from headway_algos.on_policy.behaviour_policy import BehaviourPolicy
from headway_algos.on_policy.critics.critic_inputs import CounterfactualInputs
from headway_algos.on_policy.critics.estimate import CriticEstimate
from headway_algos.on_policy.critics.return_regression import ReturnNetworks, ReturnRegression
from headway_algos.on_policy.critics.reward_streams import lambda_advantages
from headway_algos.on_policy.gae import counterfactual_advantages


class CounterfactualCritic:
    """Q(s, u^-a, o^a, id_a) with an output for each own action, and a target network.

    Advantages weigh the action taken against the policy's own mean over its actions, the others' held
    fixed. Returns are TD(lambda) targets over the target network's Q of the actions taken,

        y_t = r_t + gamma ((1 - lambda) Q'(s_t+1, u_t+1) + lambda y_t+1),

    which is Q' plus its generalised advantage, so that ends, absences and a team's return are as for
    values. Where no action was taken (after the last step, at a final observation) the others' are drawn
    once from the policies that acted, and the own one is averaged over: sum_u pi(u|o) Q'(s, u).

    The target network is the critic, its normalisers included, as it was at the last copy: after the first
    fit, whose forerunner has seen nothing, and after every `target_every`-th from there on.
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
        """Raises ValueError if actions are not Discrete."""
        if not isinstance(spec.action_space, Discrete):
            raise ValueError(
                f"a counterfactual critic takes Discrete actions, and {spec.name} has others; "
                "use critic: local or central"
            )
        self.config, self.spec, self.seeds = config, spec, tuple(seeds)
        self.view = CounterfactualInputs(config, spec, grouping)
        self.layout = Layout(self.view.grouping, len(seeds), device, dtype)
        self.networks = ReturnNetworks(config, self.view, spec.action_space.n, seeds, self.layout)
        self.target = deepcopy(self.networks).requires_grad_(False)
        self.regression = ReturnRegression(config, self.view, seeds, self.networks, self.layout)
        self.fits = 0

    def action_values(
        self, networks: ReturnNetworks, batch: CriticBatch, hidden_states: HiddenStates | None = None
    ) -> NDArray[np.float64]:
        """Q (M, C, N, A) of each own action, the others' as in the scene; in units of return. `memories`:
        what these networks remembered, if they do."""
        return self._by_agent(networks, networks.inputs(*self._rows(batch)), batch, hidden_states)

    def _rows(self, batch: CriticBatch) -> tuple[Tensor, Tensor]:
        """What is seen, not normalised, (P, B, seen_size), and indicators (P, B, indicator_size)."""
        return self.layout.rows(self.view.features(batch)), self.layout.rows(self.view.indicators(batch))

    def _by_agent(
        self, networks: ReturnNetworks, inputs: Tensor, batch: CriticBatch, hidden_states: HiddenStates | None
    ) -> NDArray[np.float64]:
        """Q (M, C, N, A) of a scene's network inputs (P, B, input_size)."""
        hidden = None if hidden_states is None else self.layout.rows(batch.select_hidden(hidden_states))
        action_values = networks.predict(inputs, hidden).transpose(1, 2)
        return self.layout.by_agent(action_values, len(batch.observations))

    def estimate(self, trajectory: Trajectory, behaviour: BehaviourPolicy, iteration: int) -> CriticEstimate:
        """See `headway_algos.on_policy.critics.Critic`."""
        random = [generator(seed, "critic bootstrap actions", iteration) for seed in self.seeds]
        batch = CriticBatch.of_steps(trajectory)
        assert batch.actions is not None
        taken = batch.actions[..., None]
        rows = self._rows(batch)

        def value_of(batch: CriticBatch) -> NDArray[np.float64]:
            drawn = behaviour.with_drawn_actions(batch, random)
            action_values = self.action_values(self.target, drawn, target_hidden_states)
            return np.asarray((behaviour.probabilities(batch) * action_values).sum(axis=-1))

        target_inputs = self.target.inputs(*rows)
        target_hidden_states = self.target.replay(target_inputs, trajectory, self.view, self.layout)
        target_values = self._by_agent(self.target, target_inputs, batch, target_hidden_states)
        target_values = np.take_along_axis(target_values, taken, axis=-1)[..., 0]
        ahead, present = lambda_advantages(
            trajectory, self.view, target_values, value_of, self.config, self.spec, self.layout.replicas
        )
        inputs = self.networks.inputs(*rows)
        hidden_states = self.networks.replay(inputs, trajectory, self.view, self.layout)
        action_values = self._by_agent(self.networks, inputs, batch, hidden_states)
        return CriticEstimate(
            counterfactual_advantages(action_values, batch.actions, behaviour.probabilities(batch), present),
            np.take_along_axis(action_values, taken, axis=-1)[..., 0],
            ahead + target_values,
            present,
            inputs,
            self.layout.rows(batch.actions),
            hidden_states,
            target_hidden_states,
        )

    def fit(self, estimate: CriticEstimate, iteration: int) -> dict[str, NDArray[np.float64]]:
        """See `headway_algos.on_policy.critics.Critic`; renews the target network when it is due."""
        metrics = self.regression.fit(estimate, iteration)
        self.target.carry(estimate.target_hidden_states)
        if self.fits % self.config.target_every == 0:
            self.target.load_state_dict(self.networks.state_dict())
            self.target.carry(estimate.hidden_states)
        self.fits += 1
        return metrics

    def update_normalisers(self, trajectory: Trajectory) -> None:
        """See `headway_algos.on_policy.critics.Critic`."""
        self.regression.update_normalisers(trajectory)

    def anneal(self, share: float) -> None:
        """Set the learning rate to `share` of its base."""
        self.regression.anneal(share)

    def state_dict(self) -> dict[str, Any]:
        """Networks, normalisers, the optimiser, the target network and how often the critic was fitted."""
        state = {**self.regression.state_dict(), "target": self.target.state_dict(), "fits": self.fits}
        if self.config.model.core != "none":
            state["target_memory"] = self.target.carried_state()
        return state

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Inverse of `state_dict`; raises RuntimeError where shapes differ."""
        self.regression.load_state_dict(state)
        self.target.load_state_dict(state["target"])
        self.target.load_carried(state.get("target_memory"))
        self.fits = state["fits"]
