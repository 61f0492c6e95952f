"""COMA's critic, which compares an agent's actions (Foerster et al. 2018, arXiv:1705.08926)."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from headway.contracts import Discrete, EnvSpec, Trajectory
from headway_algos.batches.critic_batch import CriticBatch
from headway_algos.batches.hidden_states import HiddenStates
from headway_algos.grouping import Grouping
from headway_algos.on_policy.behaviour_policy import BehaviourPolicy
from headway_algos.on_policy.critics.config import CounterfactualConfig
from headway_algos.on_policy.critics.critic_inputs import CounterfactualInputs
from headway_algos.on_policy.critics.estimate import CriticEstimate
from headway_algos.on_policy.critics.return_regression import RegressionCritic, ReturnNetworks
from headway_algos.on_policy.critics.reward_streams import lambda_advantages


class CounterfactualCritic(RegressionCritic):
    """Q(s, u^-a, o^a, id_a) with one output for each action of agent a, and a target network Q'.

    Advantages are `counterfactual_advantages`. Returns are TD(lambda) targets over the target network's Q' of
    the actions taken,

        y_t = r_t + gamma ((1 - lambda) Q'(s_t+1, u_t+1) + lambda y_t+1),

    computed as Q' plus its generalised advantage, so that stream ends, absences and team returns are treated
    as for values. Where no action was taken (after the last step, at a final observation), the others'
    actions are sampled once from the behaviour policy, and Q' is averaged over the agent's own action:
    sum_u pi(u|o) Q'(s, u).

    The target network, normalisers included, is copied from the critic after the first fit and after every
    `target_every`-th fit from there on.
    """

    Inputs = CounterfactualInputs
    config: CounterfactualConfig

    def __init__(
        self,
        config: CounterfactualConfig,
        spec: EnvSpec,
        grouping: Grouping,
        seeds: Sequence[int],
        device: torch.device,
        dtype: torch.dtype,
    ) -> None:
        """Raises ValueError if actions are not Discrete."""
        if not isinstance(spec.action_space, Discrete):
            raise ValueError(
                f"a counterfactual critic needs Discrete actions, which {spec.name} does not have; "
                "use critic: local or central"
            )
        options = spec.action_space.n
        super().__init__(config, spec, grouping, seeds, device, dtype, options)
        # Not a copy: the parameters are views of one tensor now, whose products may round differently.
        self.target = ReturnNetworks(config, self.critic_inputs, options, seeds, self.layout)
        self.target.requires_grad_(False)
        self.fits = 0

    def _action_values(
        self, networks: ReturnNetworks, inputs: Tensor, batch: CriticBatch, hidden_states: HiddenStates | None
    ) -> NDArray[np.float64]:
        """Return Q (M, C, N, A) of each own action, in units of return, with the batch's other actions."""
        outputs = networks.predict(inputs, batch, hidden_states)
        return self.layout.by_agent(outputs.transpose(1, 2), len(batch.observations))

    def estimate(self, trajectory: Trajectory, behaviour: BehaviourPolicy, iteration: int) -> CriticEstimate:
        """Estimate counterfactual advantages and TD(lambda) targets (see the class)."""
        random = self.bootstrap_generators(iteration)
        batch = CriticBatch.of_steps(trajectory)
        assert batch.actions is not None
        taken, probabilities = batch.actions[..., None], behaviour.probabilities(batch)
        rows = self.networks.rows(batch)

        def value_of(batch: CriticBatch) -> NDArray[np.float64]:
            drawn = behaviour.with_drawn_actions(batch, random)
            inputs = self.target.inputs(*self.target.rows(drawn))
            action_values = self._action_values(self.target, inputs, drawn, target_hidden_states)
            return np.asarray((behaviour.probabilities(batch) * action_values).sum(axis=-1))

        target_inputs = self.target.inputs(*rows)
        target_hidden_states = self.target.replay(target_inputs, trajectory)
        of_each = self._action_values(self.target, target_inputs, batch, target_hidden_states)
        target_values = np.take_along_axis(of_each, taken, axis=-1)[..., 0]
        # The generalised advantage of Q' plus Q' is its TD(lambda) target, with ends and absences treated
        # alike.
        target_advantages, present = lambda_advantages(
            trajectory, self.critic_inputs, target_values, (probabilities * of_each).sum(axis=-1), value_of,
            self.config, self.spec, self.layout.replicas,
        )  # fmt: skip
        inputs = self.networks.inputs(*rows)
        hidden_states = self.networks.replay(inputs, trajectory)
        action_values = self._action_values(self.networks, inputs, batch, hidden_states)
        return CriticEstimate(
            counterfactual_advantages(action_values, batch.actions, probabilities, present),
            np.take_along_axis(action_values, taken, axis=-1)[..., 0],
            target_advantages + target_values,
            present,
            inputs,
            self.layout.rows(batch.actions),
            hidden_states,
            target_hidden_states,
        )

    def fit(self, estimate: CriticEstimate, iteration: int) -> dict[str, NDArray[np.float64]]:
        """Train the critic on the TD(lambda) targets, and copy it to the target network if due."""
        metrics = super().fit(estimate, iteration)
        # The target network has hidden states of its own parameters, until these are replaced.
        self.target.carry(estimate.target_hidden_states)
        if self.fits % self.config.target_every == 0:
            self.target.load_state_dict(self.networks.state_dict())
            self.target.carry(estimate.hidden_states)
        self.fits += 1
        return metrics

    def state_dict(self) -> dict[str, Any]:
        """Return the states of networks, normalisers, optimiser, target network, and the number of fits."""
        state = {**super().state_dict(), "target": self.target.state_dict(), "fits": self.fits}
        if self.config.model.core != "none":
            state["target_memory"] = self.target.carried_state()
        return state

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore the result of `state_dict`; raises RuntimeError if shapes differ."""
        super().load_state_dict(state)
        self.target.load_state_dict(state["target"])
        self.target.load_carried(state.get("target_memory"))
        self.fits = state["fits"]


def counterfactual_advantages(
    action_values: NDArray[np.float64],
    actions: NDArray[np.int64],
    probabilities: NDArray[np.float64],
    present: NDArray[np.bool_],
) -> NDArray[np.float64]:
    """Return A^a = Q(s, u) - sum_u' pi(u'|o^a) Q(s, (u^-a, u')), (T, C, N), 0 where absent.

    Equation 4 of Foerster et al. 2018, arXiv:1705.08926. `action_values` (T, C, N, A) are Q of each own
    action, `actions` (T, C, N) those taken, `probabilities` (T, C, N, A) the policy's.
    """
    taken = np.take_along_axis(action_values, actions[..., None], axis=-1)[..., 0]
    baseline = (probabilities * action_values).sum(axis=-1)
    return np.where(present, taken - baseline, 0)
