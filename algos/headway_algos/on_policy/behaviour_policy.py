"""The policies as they acted, asked by critics that weigh actions."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from headway.contracts import ActingPolicy, Observations, RecurrentPolicy
from headway_algos.batches.critic_batch import CriticBatch
from headway_algos.batches.hidden_states import HiddenStates
from headway_algos.batches.layout import Layout, even_slices, zero_where_absent
from headway_algos.config import AlgoConfig
from headway_algos.networks.actor import Actor
from headway_algos.networks.distributions import MaskedCategorical
from headway_algos.networks.timeline import Timeline


class BehaviourPolicy:
    """What the policies do at their present parameters: ask before they are improved."""

    def __init__(
        self,
        config: AlgoConfig,
        actor: Actor,
        acting: ActingPolicy,
        layout: Layout,
        memories: HiddenStates | None = None,
    ) -> None:
        """`memories`: what was remembered along the trajectory that is judged, by policies that do."""
        self.config, self.actor, self.acting, self.layout = config, actor, acting, layout
        self.memories = memories

    def remembering(self, memories: HiddenStates | None) -> "BehaviourPolicy":
        """The same along a trajectory of which this was remembered."""
        return BehaviourPolicy(self.config, self.actor, self.acting, self.layout, memories)

    def probabilities(self, scene: CriticBatch) -> NDArray[np.float64]:
        """Chances of each action, (M, C, N, A), of Discrete actions only; exactly 0 for forbidden ones.
        Computed in pieces that stay in the cache."""
        observations = self.layout.rows(scene.observations)
        masks = None if scene.masks is None else self.layout.rows(scene.masks)
        memory = None
        if self.memories is not None:
            memory = self.layout.rows(scene.remembered(self.memories))
        parts = []
        with torch.no_grad():
            for piece in even_slices(observations.shape[1], len(observations), self.config.piece_samples):
                rows = observations[:, piece]
                if self.config.normalise_observations:
                    rows = self.actor.moments.normalised(rows)
                timeline = None if memory is None else Timeline.of_moments(memory[:, piece])
                distribution = self.actor(rows, None if masks is None else masks[:, piece], timeline)
                assert isinstance(distribution, MaskedCategorical)
                parts.append(distribution.log_probs.exp().transpose(1, 2))
        return self.layout.by_agent(torch.cat(parts, dim=1), len(scene.observations))

    def drawn(self, scene: CriticBatch, generators: Sequence[np.random.Generator]) -> CriticBatch:
        """The scene with actions as a worker would have drawn them next, each replica's with its own of the
        generators (R,)."""
        moments, replicas = len(scene.observations), len(generators)
        masks = None if scene.masks is None else _by_replica(scene.masks, replicas)
        observed = Observations(
            _by_replica(scene.observations, replicas),
            _by_replica(scene.states, replicas),
            _by_replica(scene.present, replicas),
            masks,
        )
        each = len(observed.alive) // replicas
        noise = np.concatenate([self.acting.noise(random, each) for random in generators])
        parameters = self.actor.acting_parameters()
        if isinstance(self.acting, RecurrentPolicy):
            assert self.memories is not None
            memory = _by_replica(scene.remembered(self.memories), replicas)
            actions = self.acting.act_from(parameters, observed, memory, noise)[0]
        else:
            actions, _ = self.acting.act(parameters, observed, noise)
        split = actions.reshape(replicas, moments, -1, *actions.shape[1:])
        by_moment = np.moveaxis(split, 0, 1).reshape(moments, -1, *actions.shape[1:])
        return replace(scene, actions=zero_where_absent(by_moment, scene.present))


def _by_replica(array: NDArray[Any], replicas: int) -> NDArray[Any]:
    """(M, C, ...) -> (R x M x E, ...): all moments of a replica as if they were copies of it."""
    moments, copies, *rest = array.shape
    split = array.reshape(moments, replicas, copies // replicas, *rest)
    return np.moveaxis(split, 1, 0).reshape(moments * copies, *rest)
