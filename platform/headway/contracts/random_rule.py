"""The rule `random`: uniformly random play, the zero point of normalised scores."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from headway.contracts.entries import RuleEntry
from headway.contracts.environment import BatchedEnv, Observations
from headway.contracts.random_streams import generator
from headway.contracts.spaces import ActionSpace, Box, Discrete

_UNBOUNDED_WIDTH = 10.0
"""Maximum distance of a draw from the only finite bound of a Box component, or from 0 if it has none."""


def random_actions(
    space: ActionSpace, draw: np.random.Generator, shape: tuple[int, ...], masks: NDArray[np.bool_] | None
) -> NDArray[Any]:
    """Return uniformly random actions for agents of any `shape`, allowed by `masks` (*shape, A).

    Agents without an allowed action get action 0.
    """
    if isinstance(space, Box):
        low, high = np.array(space.low), np.array(space.high)
        floor = np.where(np.isinf(low), np.where(np.isinf(high), 0.0, high) - _UNBOUNDED_WIDTH, low)
        ceiling = np.where(np.isinf(high), np.where(np.isinf(low), 0.0, low) + _UNBOUNDED_WIDTH, high)
        return draw.uniform(floor, ceiling, (*shape, space.size)).astype(np.float32)
    score = draw.random((*shape, sum(space.options)))
    if masks is not None:
        # Draws are at least 0, so -1 loses against every allowed action.
        score = np.where(masks, score, -1.0)
    if isinstance(space, Discrete):
        actions: NDArray[Any] = score.argmax(axis=-1)
        return actions
    return np.stack([part.argmax(axis=-1) for part in space.split(score)], axis=-1)


class RandomRule:
    """Draws each action uniformly among those allowed.

    Two rules with the same `seed` and the same sequence of calls make the same draws.
    """

    def __init__(self, seed: int = 0) -> None:
        self._generator = generator(seed, "random rule")

    def act(self, env: BatchedEnv, observed: Observations) -> NDArray[Any]:
        """Return actions as `BatchedEnv.step` takes them. Agents without an allowed action get action 0."""
        shape, masks = observed.alive.shape, observed.action_masks
        return random_actions(env.spec.action_space, self._generator, shape, masks)


RANDOM = RuleEntry(
    "plays uniformly at random among the allowed actions; its return is 0 on the normalised scale",
    lambda prepared: RandomRule(),
)
"""The rule `random`, registered for every environment."""
