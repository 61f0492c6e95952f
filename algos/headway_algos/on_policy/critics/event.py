"""Critic that separates what other agents did between two of an agent's own decisions."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from headway.contracts import EnvSpec, Trajectory
from headway_algos.batches.critic_batch import CriticBatch
from headway_algos.grouping import Grouping
from headway_algos.on_policy.behaviour_policy import BehaviourPolicy
from headway_algos.on_policy.critics.config import CriticConfig
from headway_algos.on_policy.critics.critic_inputs import EventInputs
from headway_algos.on_policy.critics.estimate import CriticEstimate
from headway_algos.on_policy.critics.return_regression import RegressionCritic
from headway_algos.on_policy.critics.value import LocalCritic

_EVENTS = "events_"
"""Prefix of the metrics and the state of G."""


class EventRegression(RegressionCritic):
    """Contribution of the other agents' decisions to an agent's return, beyond V(o)."""

    Inputs = EventInputs
    purpose = "critic of events"


class EventCritic(LocalCritic):
    """V(o) + G(o, e), with e the other agents' decisions up to the agent's next one.

    After CAAC (Wang and Sun 2021, arXiv:2105.00376), whose critic adds a value of the agent's own event and
    one of the other buses' events until its next, and improves policies by the first alone. Here V is a local
    critic, with returns R = V + its generalised advantage; G is fitted to R - V, and advantages are R - V -
    G: what others did is not credited to the agent. G approximates that part as a function of events that
    follow the action, so advantages are biased where others respond to it, as in CAAC.

    Differences from CAAC: G is a network of the mean event instead of graph attention over events up- and
    downstream, and policies are updated on-policy instead of by deterministic gradients.
    """

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
        super().__init__(config, spec, grouping, seeds, device, dtype)
        self.events = EventRegression(config, spec, grouping, seeds, device, dtype)

    def estimate(self, trajectory: Trajectory, behaviour: BehaviourPolicy, iteration: int) -> CriticEstimate:
        """Estimate values, and advantages less the contribution of the others' events."""
        own, events = super().estimate(trajectory, behaviour, iteration), self.events
        batch = CriticBatch.of_steps(trajectory)
        inputs = events.networks.inputs(*events.networks.rows(batch))
        hidden_states = events.networks.replay(inputs, trajectory)
        outputs = events.networks.predict(inputs, batch, hidden_states)
        contribution = events.layout.by_agent(outputs[:, 0], len(batch.observations))
        of_events = replace(
            own, values=contribution, returns=own.advantages, inputs=inputs, hidden_states=hidden_states
        )
        advantages = np.where(own.present, own.advantages - contribution, 0.0)
        return replace(own, advantages=advantages, events=of_events)

    def fit(self, estimate: CriticEstimate, iteration: int) -> dict[str, NDArray[np.float64]]:
        """Train V on the returns and G on what V leaves of them; metrics of G begin with `events_`."""
        assert estimate.events is not None
        metrics = super().fit(estimate, iteration)
        of_events = self.events.fit(estimate.events, iteration)
        return metrics | _of_events(of_events)

    def update_normalisers(self, trajectory: Trajectory) -> None:
        """Include an iteration's inputs in the running statistics of both."""
        super().update_normalisers(trajectory)
        self.events.update_normalisers(trajectory)

    def anneal(self, share: float) -> None:
        """Set the learning rates to `share` of their configured value."""
        super().anneal(share)
        self.events.anneal(share)

    def state_dict(self) -> dict[str, Any]:
        """Return the states of V and of G, whose names begin with `events_`."""
        return super().state_dict() | _of_events(self.events.state_dict())

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore the result of `state_dict`; raises RuntimeError if shapes differ."""
        super().load_state_dict(state)
        own = {name.removeprefix(_EVENTS): part for name, part in state.items() if name.startswith(_EVENTS)}
        self.events.load_state_dict(own)


def _of_events(values: Mapping[str, Any]) -> dict[str, Any]:
    return {f"{_EVENTS}{name}": value for name, value in values.items()}
