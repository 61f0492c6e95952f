"""What critics look at."""

from collections.abc import Callable
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from headway.contracts import ActionSpace, Box, Discrete, EnvSpec
from headway_algos.acting.mlp import actor_outputs
from headway_algos.batches.critic_batch import CriticBatch
from headway_algos.batches.layout import zero_where_absent
from headway_algos.config import AlgoConfig
from headway_algos.grouping import Grouping


class CriticInputs(Protocol):
    """What a critic sees from each of W viewpoints: N agents, or 1 for a whole team."""

    grouping: Grouping
    """Of viewpoints into the networks of one replica."""
    viewpoints: int
    """W"""
    team: bool
    """What it values is the team's return, which goes on until the episode ends, whoever is present."""
    whole: bool
    """It values the team as one, not as its agents await it: W is 1, and there is always a value."""
    asks_actions: bool
    """Its inputs need the actions of a scene."""
    seen_size: int
    indicator_size: int

    def seen(self, scene: CriticBatch) -> NDArray[np.float32]:
        """Measurements, to be normalised: (M, C, W, seen_size)."""
        ...

    def indicators(self, scene: CriticBatch) -> NDArray[np.float32] | None:
        """What is taken as it is, (M, C, W, indicator_size): actions, and who looks; None where size is 0."""
        ...


class LocalInputs:
    """V(o): each agent's own observation, one critic a policy."""

    team = whole = asks_actions = False

    def __init__(self, config: AlgoConfig, spec: EnvSpec, grouping: Grouping) -> None:
        self.grouping, self.viewpoints = grouping, spec.num_agents
        self.seen_size, self.indicator_size = spec.observation_size, 0

    def seen(self, scene: CriticBatch) -> NDArray[np.float32]:
        """The observations themselves."""
        return scene.observations

    def indicators(self, scene: CriticBatch) -> None:
        """None."""


class CentralInputs:
    """V(s): the global state, or all observations in a row where the environment gives none.

    For a shared team reward there is one critic a replica, with one viewpoint. Otherwise there is one a
    policy, seen from every agent: each one's own observation follows the state, since a state of totals does
    not say whose value is asked for (the agent-specific global state of Yu et al. 2022,
    arXiv:2103.01955). With `critic_actions: others` the actions of the others follow, V(s, u^-a), which
    differ from agent to agent, so that a team's critic too has every agent's viewpoint.
    """

    def __init__(self, config: AlgoConfig, spec: EnvSpec, grouping: Grouping) -> None:
        self.space, self.team = spec.action_space, spec.shared_reward
        self.asks_actions = config.critic_actions == "others"
        self.whole = self.team and not self.asks_actions
        self.viewpoints = 1 if self.whole else spec.num_agents
        self.grouping = Grouping(np.arange(self.viewpoints)[None]) if self.team else grouping
        self.has_state = spec.state_size > 0
        self.own_observation = not self.team
        self.seen_size = _state_size(spec) + (spec.observation_size if self.own_observation else 0)
        self.indicator_size = spec.num_agents * actor_outputs(spec) if self.asks_actions else 0

    def seen(self, scene: CriticBatch) -> NDArray[np.float32]:
        """The state from every viewpoint, and the own observation where that tells viewpoints apart."""
        state = _from_everywhere(_state(scene, self.has_state), self.viewpoints)
        return np.concatenate([state, scene.observations], axis=-1) if self.own_observation else state

    def indicators(self, scene: CriticBatch) -> NDArray[np.float32] | None:
        """The others' actions, if asked for."""
        return others_actions(scene, self.space) if self.asks_actions else None


class CounterfactualInputs:
    """Q(s, u^-a, o^a, id_a): state, own observation, the others' actions and who looks (Foerster et al.
    2018, arXiv:1705.08926, section 4).

    For a shared team reward there is one critic a replica, whose agents learn from each other's rows, with
    rewards of their own one a policy.
    """

    asks_actions, whole = True, False

    def __init__(self, config: AlgoConfig, spec: EnvSpec, grouping: Grouping) -> None:
        self.space, self.team, self.viewpoints = spec.action_space, spec.shared_reward, spec.num_agents
        self.grouping = Grouping(np.arange(spec.num_agents)[None]) if self.team else grouping
        self.has_state = spec.state_size > 0
        self.seen_size = _state_size(spec) + spec.observation_size
        self.indicator_size = spec.num_agents * (actor_outputs(spec) + 1)

    def seen(self, scene: CriticBatch) -> NDArray[np.float32]:
        """State and own observation."""
        state = _from_everywhere(_state(scene, self.has_state), self.viewpoints)
        return np.concatenate([state, scene.observations], axis=-1)

    def indicators(self, scene: CriticBatch) -> NDArray[np.float32]:
        """The others' actions, one-hot, and the agent's index, one-hot."""
        agents = np.eye(self.viewpoints, dtype=np.float32)
        index = np.broadcast_to(agents, (*scene.present.shape[:2], *agents.shape))
        return np.concatenate([others_actions(scene, self.space), index], axis=-1)


def _state_size(spec: EnvSpec) -> int:
    return spec.state_size or spec.num_agents * spec.observation_size


def _state(scene: CriticBatch, has_state: bool) -> NDArray[np.float32]:
    """(M, C, S)"""
    if has_state:
        return scene.states
    joint = zero_where_absent(scene.observations, scene.in_joint)
    return joint.reshape(*joint.shape[:2], -1)


def _from_everywhere(seen: NDArray[np.float32], viewpoints: int) -> NDArray[np.float32]:
    """(M, C, S) -> (M, C, W, S), a view."""
    return np.broadcast_to(seen[:, :, None], (*seen.shape[:2], viewpoints, seen.shape[2]))


def others_actions(scene: CriticBatch, space: ActionSpace) -> NDArray[np.float32]:
    """(M, C, N, N x A): what each agent's teammates chose, one block of A a teammate: one-hot if Discrete,
    the action as the environment cuts it if Box. Zeros stand in the agent's own block and in those of
    agents that are not in the joint input.

    A choice counts even where it was not used (`acting` false): whether it would be is known only after
    the step, and may be an effect of the very action that is being judged.
    """
    assert scene.actions is not None
    match space:
        case Discrete(n=n):
            chosen = (scene.actions[..., None] == np.arange(n)).astype(np.float32)
        case Box(low=low, high=high):
            chosen = np.clip(scene.actions, low, high).astype(np.float32)
        case _:
            raise TypeError(f"actions of {space} are not encoded")
    chosen = zero_where_absent(chosen, scene.in_joint)
    agents = chosen.shape[2]
    blocks = np.repeat(chosen[:, :, None], agents, axis=2)
    blocks[:, :, range(agents), range(agents)] = 0
    return blocks.reshape(*blocks.shape[:3], -1)


VIEWS: dict[str, Callable[[AlgoConfig, EnvSpec, Grouping], CriticInputs]] = {
    "local": LocalInputs,
    "central": CentralInputs,
}
