"""The behaviour policy: action probabilities and sampled actions, for critics that need them."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from headway.contracts import ActingPolicy, Observations, RecurrentPolicy
from headway_algos.batches.critic_batch import CriticBatch
from headway_algos.batches.hidden_states import HiddenStates
from headway_algos.batches.layout import Layout, zero_where_absent
from headway_algos.batches.minibatches import even_slices
from headway_algos.config import AlgoConfig
from headway_algos.networks.actor import Actor
from headway_algos.networks.distributions import MaskedCategorical
from headway_algos.networks.timeline import Timeline


@dataclass(frozen=True)
class BehaviourPolicy:
    """The policies at their current parameters; valid as behaviour policy until they are updated."""

    config: AlgoConfig
    actor: Actor
    acting: ActingPolicy
    layout: Layout
    hidden_states: HiddenStates | None = None
    """Hidden states of the trajectory to evaluate, if the policies are recurrent."""

    def probabilities(self, batch: CriticBatch) -> NDArray[np.float64]:
        """Return action probabilities (M, C, N, A), exactly 0 for forbidden actions. Discrete actions only.

        Computed in pieces that fit the cache.
        """
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
        """Return the batch with actions sampled as by a worker, with one generator per replica (R,)."""
        points, replicas = len(batch.observations), len(generators)
        masks = None if batch.masks is None else _by_replica(batch.masks, replicas)
        observed = Observations(
            _by_replica(batch.observations, replicas),
            _by_replica(batch.states, replicas),
            _by_replica(batch.present, replicas),
            masks,
        )
        rows = len(observed.alive) // replicas
        noise = np.concatenate([self.acting.noise(random, rows) for random in generators])
        parameters = self.actor.acting_parameters()
        if isinstance(self.acting, RecurrentPolicy):
            assert self.hidden_states is not None
            hidden = _by_replica(batch.select_hidden(self.hidden_states), replicas)
            actions = self.acting.act_from(parameters, observed, hidden, noise)[0]
        else:
            actions, _ = self.acting.act(parameters, observed, noise)
        split = actions.reshape(replicas, points, -1, *actions.shape[1:])
        by_point = np.moveaxis(split, 0, 1).reshape(points, -1, *actions.shape[1:])
        return replace(batch, actions=zero_where_absent(by_point, batch.present))


def _by_replica(array: NDArray[Any], replicas: int) -> NDArray[Any]:
    """Convert (M, C, ...) to (R x M x E, ...), so that a replica's M time points count as copies."""
    points, copies, *rest = array.shape
    split = array.reshape(points, replicas, copies // replicas, *rest)
    return np.moveaxis(split, 1, 0).reshape(points * copies, *rest)
