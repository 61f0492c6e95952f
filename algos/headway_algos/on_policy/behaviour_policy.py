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
        hidden_states: HiddenStates | None = None,
    ) -> None:
        """`memories`: what was remembered along the trajectory that is judged, by policies that do."""
        self.config, self.actor, self.acting, self.layout = config, actor, acting, layout
        self.hidden_states = hidden_states

    def with_hidden_states(self, hidden_states: HiddenStates | None) -> "BehaviourPolicy":
        """The same along a trajectory of which this was remembered."""
        return BehaviourPolicy(self.config, self.actor, self.acting, self.layout, hidden_states)

    def probabilities(self, batch: CriticBatch) -> NDArray[np.float64]:
        """Chances of each action, (M, C, N, A), of Discrete actions only; exactly 0 for forbidden ones.
        Computed in pieces that stay in the cache."""
        observations = self.layout.rows(batch.observations)
        masks = None if batch.masks is None else self.layout.rows(batch.masks)
        hidden = None
        if self.hidden_states is not None:
            hidden = self.layout.rows(batch.select_hidden(self.hidden_states))
        parts = []
        with torch.no_grad():
            for piece in even_slices(observations.shape[1], len(observations), self.config.piece_samples):
                rows = observations[:, piece]
                if self.config.normalise_observations:
                    rows = self.actor.moments.normalised(rows)
                timeline = None if hidden is None else Timeline.of_rows(hidden[:, piece])
                distribution = self.actor(rows, None if masks is None else masks[:, piece], timeline)
                assert isinstance(distribution, MaskedCategorical)
                parts.append(distribution.log_probs.exp().transpose(1, 2))
        return self.layout.by_agent(torch.cat(parts, dim=1), len(batch.observations))

    def with_drawn_actions(
        self, batch: CriticBatch, generators: Sequence[np.random.Generator]
    ) -> CriticBatch:
        """The scene with actions as a worker would have drawn them next, each replica's with its own of the
        generators (R,)."""
        moments, replicas = len(batch.observations), len(generators)
        masks = None if batch.masks is None else _by_replica(batch.masks, replicas)
        observed = Observations(
            _by_replica(batch.observations, replicas),
            _by_replica(batch.states, replicas),
            _by_replica(batch.present, replicas),
            masks,
        )
        each = len(observed.alive) // replicas
        noise = np.concatenate([self.acting.noise(random, each) for random in generators])
        parameters = self.actor.acting_parameters()
        if isinstance(self.acting, RecurrentPolicy):
            assert self.hidden_states is not None
            hidden = _by_replica(batch.select_hidden(self.hidden_states), replicas)
            actions = self.acting.act_from(parameters, observed, hidden, noise)[0]
        else:
            actions, _ = self.acting.act(parameters, observed, noise)
        split = actions.reshape(replicas, moments, -1, *actions.shape[1:])
        by_moment = np.moveaxis(split, 0, 1).reshape(moments, -1, *actions.shape[1:])
        return replace(batch, actions=zero_where_absent(by_moment, batch.present))


def _by_replica(array: NDArray[Any], replicas: int) -> NDArray[Any]:
    """(M, C, ...) -> (R x M x E, ...): all moments of a replica as if they were copies of it."""
    moments, copies, *rest = array.shape
    split = array.reshape(moments, replicas, copies // replicas, *rest)
    return np.moveaxis(split, 1, 0).reshape(moments * copies, *rest)
