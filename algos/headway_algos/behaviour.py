"""The policies as they acted, asked by critics that weigh actions."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from headway.contracts import Observed
from headway_algos.acting import StackedActingPolicy
from headway_algos.actor import Actor
from headway_algos.config import AlgoConfig
from headway_algos.distributions import MaskedCategorical
from headway_algos.experience import Layout, even_slices, zero_where_absent
from headway_algos.scenes import Scene


class Behaviour:
    """What the policies do at their present parameters: ask before they are improved."""

    def __init__(self, config: AlgoConfig, actor: Actor, acting: StackedActingPolicy, layout: Layout) -> None:
        self.config, self.actor, self.acting, self.layout = config, actor, acting, layout

    def probabilities(self, scene: Scene) -> NDArray[np.float64]:
        """Chances of each action, (M, C, N, A), of Discrete actions only; exactly 0 for forbidden ones.
        Computed in pieces that stay in the cache."""
        observations = self.layout.rows(scene.observations)
        masks = None if scene.masks is None else self.layout.rows(scene.masks)
        parts = []
        with torch.no_grad():
            for piece in even_slices(observations.shape[1], len(observations), self.config.piece_samples):
                rows = observations[:, piece]
                if self.config.normalise_observations:
                    rows = self.actor.normalise(rows)
                distribution = self.actor(rows, None if masks is None else masks[:, piece])
                assert isinstance(distribution, MaskedCategorical)
                parts.append(distribution.log_probs.exp().transpose(1, 2))
        return self.layout.by_agent(torch.cat(parts, dim=1), len(scene.observations))

    def drawn(self, scene: Scene, generators: Sequence[np.random.Generator]) -> Scene:
        """The scene with actions as a worker would have drawn them next, each replica's with its own of the
        generators (R,)."""
        moments, replicas = len(scene.observations), len(generators)
        masks = None if scene.masks is None else _by_replica(scene.masks, replicas)
        observed = Observed(
            _by_replica(scene.observations, replicas),
            _by_replica(scene.states, replicas),
            _by_replica(scene.present, replicas),
            masks,
        )
        each = len(observed.alive) // replicas
        noise = np.concatenate([self.acting.noise(random, each) for random in generators])
        actions, _ = self.acting.act(self.actor.acting_parameters(), observed, noise)
        split = actions.reshape(replicas, moments, -1, *actions.shape[1:])
        by_moment = np.moveaxis(split, 0, 1).reshape(moments, -1, *actions.shape[1:])
        return replace(scene, actions=zero_where_absent(by_moment, scene.present))


def _by_replica(array: NDArray[Any], replicas: int) -> NDArray[Any]:
    """(M, C, ...) -> (R x M x E, ...): all moments of a replica as if they were copies of it."""
    moments, copies, *rest = array.shape
    split = array.reshape(moments, replicas, copies // replicas, *rest)
    return np.moveaxis(split, 1, 0).reshape(moments * copies, *rest)
