"""Uniformly random play: the zero of a normalised score, and a rule of every environment."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from headway.contracts.entries import RuleEntry
from headway.contracts.environment import BatchedEnv, Observations
from headway.contracts.random_streams import generator
from headway.contracts.spaces import Box, Discrete, MultiDiscrete

WIDTH = 10.0
"""Where a Box has no bound, actions are drawn up to so far from the other bound, or from 0."""


class RandomRule:
    """Uniform over the allowed actions of a Discrete space, over all of a MultiDiscrete or Box one.

    Each rule of the same `seed` makes the same draws, in the order in which it is asked.
    """

    def __init__(self, seed: int = 0) -> None:
        self._generator = generator(seed, "random rule")

    def act(self, env: BatchedEnv, observed: Observations) -> NDArray[Any]:
        """As `BatchedEnv.step` takes them; agents with no allowed action get action 0."""
        shape, draw = observed.alive.shape, self._generator
        match env.spec.action_space:
            case Discrete(n=n):
                score = draw.random((*shape, n))
                if observed.action_masks is not None:
                    score = np.where(observed.action_masks, score, -1.0)
                actions: NDArray[Any] = score.argmax(axis=-1)
                return actions
            case MultiDiscrete(nvec=nvec):
                return draw.integers(0, nvec, (*shape, len(nvec)))
            case Box(low=low, high=high):
                floor = np.where(np.isinf(low), np.where(np.isinf(high), 0.0, high) - WIDTH, low)
                ceiling = np.where(np.isinf(high), np.where(np.isinf(low), 0.0, low) + WIDTH, high)
                return draw.uniform(floor, ceiling, (*shape, len(low))).astype(np.float32)


RANDOM = RuleEntry(
    "plays uniformly at random, of discrete actions those allowed: the zero of normalised scores",
    lambda prepared: RandomRule(),
)
"""The rule `random`, of every environment."""
