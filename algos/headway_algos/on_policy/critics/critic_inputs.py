"""Network inputs of critics."""

from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from headway.contracts import ActionSpace, Box, Discrete, EnvSpec, MultiDiscrete
from headway_algos.acting.mlp import actor_outputs
from headway_algos.agent_id import agent_ids
from headway_algos.batches.critic_batch import CriticBatch
from headway_algos.batches.layout import zero_where_absent
from headway_algos.config import AlgoConfig
from headway_algos.grouping import Grouping
from headway_algos.on_policy.critics.config import CentralConfig


class CriticInputs(Protocol):
    """Inputs of a critic from W viewpoints per copy: N for a critic per agent, 1 for a critic per team."""

    grouping: Grouping
    """Assignment of viewpoints to the critic networks of one replica."""
    viewpoints: int
    """W: viewpoints per copy."""
    single: bool
    """One value per team: W is 1, and the value exists also while no agent is alive."""
    needs_actions: bool
    """The inputs include actions."""
    feature_size: int
    indicator_size: int

    def __init__(self, config: AlgoConfig, spec: EnvSpec, grouping: Grouping) -> None: ...

    def features(self, batch: CriticBatch) -> NDArray[np.float32]:
        """Return the inputs to be normalised, (M, C, W, feature_size)."""
        ...

    def indicators(self, batch: CriticBatch) -> NDArray[np.float32] | None:
        """Return the inputs left unnormalised, (M, C, W, indicator_size): actions, agent index; or None."""
        ...


class LocalInputs:
    """V(o): each agent's own observation, one critic per policy."""

    single = needs_actions = False

    def __init__(self, config: AlgoConfig, spec: EnvSpec, grouping: Grouping) -> None:
        self.grouping, self.viewpoints = grouping, spec.num_agents
        self.feature_size, self.indicator_size = spec.observation_size, 0

    def features(self, batch: CriticBatch) -> NDArray[np.float32]:
        """Return the observations (M, C, N, D)."""
        return batch.observations

    def indicators(self, batch: CriticBatch) -> None:
        """Return None: there are no indicators."""


class _StateInputs:
    """The global state, or all observations concatenated if the environment has no state."""

    viewpoints: int

    def __init__(self, config: AlgoConfig, spec: EnvSpec) -> None:
        self.space, self.has_state = spec.action_space, spec.state_size > 0
        # Joint inputs do not need the columns of the agents' indices.
        self.joint_size = spec.observation_size - int(agent_ids(config, spec).shape[1])
        self.joint_state_size = spec.state_size or spec.num_agents * self.joint_size

    def state(self, batch: CriticBatch) -> NDArray[np.float32]:
        """Return the state (M, C, W, joint_state_size) for every viewpoint, as a view."""
        state = batch.states
        if not self.has_state:
            joint = zero_where_absent(batch.observations[..., : self.joint_size], batch.in_joint)
            state = joint.reshape(*joint.shape[:2], -1)
        return np.broadcast_to(state[:, :, None], (*state.shape[:2], self.viewpoints, state.shape[2]))


class CentralInputs(_StateInputs):
    """V(s): the global state, or all observations concatenated if the environment has no state.

    With a shared team reward there is one critic per replica, with one viewpoint. Otherwise there is one
    critic per policy and a viewpoint per agent: the agent's observation is appended to the state, which alone
    does not identify the agent (the agent-specific global state of Yu et al. 2022, arXiv:2103.01955). With
    `critic_actions: others` the other agents' actions are appended, V(s, u^-a); they differ between agents,
    so a team's critic has a viewpoint per agent too.
    """

    def __init__(self, config: AlgoConfig, spec: EnvSpec, grouping: Grouping) -> None:
        super().__init__(config, spec)
        team = spec.shared_reward
        self.needs_actions = isinstance(config, CentralConfig) and config.critic_actions == "others"
        self.single = team and not self.needs_actions
        self.viewpoints = 1 if self.single else spec.num_agents
        self.grouping = Grouping(np.arange(self.viewpoints)[None]) if team else grouping
        self.own_observation = not team
        self.feature_size = self.joint_state_size + (spec.observation_size if self.own_observation else 0)
        self.indicator_size = spec.num_agents * actor_outputs(spec) if self.needs_actions else 0

    def features(self, batch: CriticBatch) -> NDArray[np.float32]:
        """Return the state per viewpoint; with individual rewards, each agent's observation is appended."""
        state = self.state(batch)
        return np.concatenate([state, batch.observations], axis=-1) if self.own_observation else state

    def indicators(self, batch: CriticBatch) -> NDArray[np.float32] | None:
        """Return the other agents' actions with `critic_actions: others`, else None."""
        return others_actions(batch, self.space) if self.needs_actions else None


class CounterfactualInputs(_StateInputs):
    """Q(s, u^-a, o^a, id_a): state, own observation, the others' actions and the agent's index.

    Source: Foerster et al. 2018, arXiv:1705.08926, section 4. With a shared team reward there is one critic
    per replica, trained on all agents' rows; with individual rewards, one per policy.
    """

    needs_actions, single = True, False

    def __init__(self, config: AlgoConfig, spec: EnvSpec, grouping: Grouping) -> None:
        super().__init__(config, spec)
        self.viewpoints = spec.num_agents
        self.grouping = Grouping(np.arange(spec.num_agents)[None]) if spec.shared_reward else grouping
        self.feature_size = self.joint_state_size + self.joint_size
        self.indicator_size = spec.num_agents * (actor_outputs(spec) + 1)

    def features(self, batch: CriticBatch) -> NDArray[np.float32]:
        """Return state and own observation for every agent."""
        return np.concatenate([self.state(batch), batch.observations[..., : self.joint_size]], axis=-1)

    def indicators(self, batch: CriticBatch) -> NDArray[np.float32]:
        """Return the other agents' actions and the agent's index, both one-hot."""
        agents = np.eye(self.viewpoints, dtype=np.float32)
        index = np.broadcast_to(agents, (*batch.present.shape[:2], *agents.shape))
        return np.concatenate([others_actions(batch, self.space), index], axis=-1)


class EventInputs:
    """Own observation, and the mean of the other agents' events: see `events_until_next_decision`.

    An event is a decision of another agent of the same group: its observation and action.
    """

    needs_actions, single = True, False

    def __init__(self, config: AlgoConfig, spec: EnvSpec, grouping: Grouping) -> None:
        self.space, self.grouping, self.viewpoints = spec.action_space, grouping, spec.num_agents
        self.groups = np.unique(spec.groups or [""] * spec.num_agents, return_inverse=True)[1]
        self.feature_size, self.indicator_size = 2 * spec.observation_size, actor_outputs(spec) + 1

    def features(self, batch: CriticBatch) -> NDArray[np.float32]:
        """Return each agent's observation, and the mean observation at the others' events; 0 without any."""
        _, means = self._events(batch, batch.observations)
        return np.concatenate([batch.observations, means], axis=-1)

    def indicators(self, batch: CriticBatch) -> NDArray[np.float32]:
        """Return the mean action of the others' events, and their number per agent."""
        assert batch.actions is not None
        counts, means = self._events(batch, encoded_actions(batch.actions, self.space))
        return np.concatenate([means, counts / self.viewpoints], axis=-1)

    def _events(
        self, batch: CriticBatch, values: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return numbers (M, C, N, 1) and means (M, C, N, F) of `values` (M, C, N, F) over the events."""
        assert batch.decides is not None
        assert batch.ends is not None
        counted = np.concatenate([values, np.ones_like(values[..., :1])], axis=-1)
        totals = events_until_next_decision(counted, batch.decides, batch.ends, self.groups)
        counts = totals[..., -1:]
        return counts, np.divide(totals[..., :-1], np.maximum(counts, 1), dtype=np.float32)


def events_until_next_decision(
    values: NDArray[np.float32],
    decides: NDArray[np.bool_],
    ends: NDArray[np.bool_],
    groups: NDArray[np.int64],
) -> NDArray[np.float32]:
    """Return sums (M, C, N, F) of `values` (M, C, N, F) over the other agents' decisions.

    For agent a at step t they are the decisions, from t on, of all others of its group (`groups`, (N,))
    before a's next one after t. Decisions after the end of a's stream or after the last step do not count.
    """
    events = zero_where_absent(values, decides)
    of_group = np.empty_like(events)
    for group in range(int(groups.max()) + 1):
        members = np.flatnonzero(groups == group)
        of_group[:, :, members] = events[:, :, members].sum(axis=2, keepdims=True)
    sums: NDArray[np.float32] = of_group - events
    for t in range(len(sums) - 2, -1, -1):
        goes_on = ~(decides[t + 1] | ends[t])
        sums[t] += np.where(goes_on[..., None], sums[t + 1], 0.0)
    return sums


def others_actions(batch: CriticBatch, space: ActionSpace) -> NDArray[np.float32]:
    """Return the other agents' actions (M, C, N, N x A), one block of A per agent.

    Discrete actions are one-hot, as is each choice of MultiDiscrete ones; Box actions are clipped to the
    bounds. The agent's own block and those of absent agents are 0. Actions that the environment did not
    use (`acting` false) are included: whether an action is used is known only after the step, and may
    depend on the action being evaluated.
    """
    assert batch.actions is not None
    chosen = zero_where_absent(encoded_actions(batch.actions, space), batch.in_joint)
    agents = chosen.shape[2]
    blocks = np.repeat(chosen[:, :, None], agents, axis=2)
    blocks[:, :, range(agents), range(agents)] = 0
    return blocks.reshape(*blocks.shape[:3], -1)


def encoded_actions(actions: NDArray[Any], space: ActionSpace) -> NDArray[np.float32]:
    """Return actions (..., A): each choice one-hot, Box actions clipped to the bounds."""
    match space:
        case Discrete(n=n):
            return np.asarray(actions[..., None] == np.arange(n), np.float32)
        case MultiDiscrete(nvec=nvec):
            each = [actions[..., i, None] == np.arange(n) for i, n in enumerate(nvec)]
            return np.concatenate(each, axis=-1).astype(np.float32)
        case Box(low=low, high=high):
            return np.asarray(np.clip(actions, low, high), np.float32)
