"""Uniformly random play: the zero of a normalised score."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from headway.contracts import BatchedEnv, Box, Discrete, MultiDiscrete, Observed, generator


class RandomRule:
    """Uniform over the allowed actions of a Discrete space, over all of a MultiDiscrete or bounded Box one.

    Each rule of the same `seed` makes the same draws, in the order in which it is asked.
    """

    def __init__(self, seed: int = 0) -> None:
        self._generator = generator(seed, "random rule")

    def act(self, env: BatchedEnv, observed: Observed) -> NDArray[Any]:
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
                return draw.uniform(low, high, (*shape, len(low))).astype(np.float32)
