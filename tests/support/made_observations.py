"""Observations of five made-up agents in three groups."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from headway.contracts import ActionSpace, Box, Discrete, EnvSpec, Observations

AGENTS, SIZE = 5, 3


def spec_with(space: ActionSpace) -> EnvSpec:
    """Return a specification of five agents; all but Box actions have masks."""
    names, masked = tuple(f"a{i}" for i in range(AGENTS)), not isinstance(space, Box)
    return EnvSpec("made", names, SIZE, space, groups=("x", "y", "x", "z", "x"), has_action_mask=masked)


def seen(
    observations: NDArray[np.float32],
    masks: NDArray[np.bool_] | None = None,
    alive: NDArray[np.bool_] | None = None,
) -> Observations:
    """Return observations without states; `alive`: all agents by default."""
    everyone = np.ones(observations.shape[:2], np.bool_) if alive is None else alive
    return Observations(observations, np.zeros((len(observations), 0), np.float32), everyone, masks)


def drawn(space: ActionSpace, copies: int, seed: int = 0) -> Observations:
    """Return random observations and masks, in which each choice has an option."""
    draw, masks = np.random.default_rng(seed), None
    if not isinstance(space, Box):
        options = (space.n,) if isinstance(space, Discrete) else space.nvec
        masks = draw.random((copies, AGENTS, sum(options))) < 0.6
        for first, last in zip(np.cumsum((0, *options)), np.cumsum(options), strict=False):
            masks[..., last - 1] |= ~masks[..., first:last].any(axis=-1)
    return seen((3 * draw.standard_normal((copies, AGENTS, SIZE))).astype(np.float32), masks)


def repeated(one: Observations, copies: int) -> Observations:
    """Return the observations of a single copy for many."""
    masks: Any = None if one.action_masks is None else np.repeat(one.action_masks, copies, axis=0)
    return seen(np.repeat(one.observations, copies, axis=0), masks)
