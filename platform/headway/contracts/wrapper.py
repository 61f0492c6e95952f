"""Wrappers by name. Third parties add theirs by entry point (`headway.wrappers`), a mapping from name to
entry."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from headway.contracts.environment import BatchedEnv


@dataclass(frozen=True)
class ObservationBounds:
    """What every agent observes: a float32 vector of D components, each between `low` and `high`."""

    agents: tuple[str, ...]
    """Names of the N agents, in array order."""
    low: NDArray[np.float32]
    """(D,); -inf where there is no bound."""
    high: NDArray[np.float32]
    """(D,)"""


@dataclass(frozen=True)
class BatchedWrapper:
    """The twin of a wrapper for batches of copies: what it gives is equal to the last bit."""

    wrap: Callable[[BatchedEnv], BatchedEnv]
    """Picklable. In what it is given, rows of absent agents are what a ParallelEnv shows them: zeros, where
    the environment is native. The result has attributes `inner`, the environment given, and `faced`, what
    that one observed last: rules look there."""
    bounds: ObservationBounds
    """Of the wrapped environment's observations."""


@dataclass(frozen=True)
class WrapperEntry:
    """A wrapper by name."""

    summary: str
    """One line for `headway list wrappers`."""
    config: type
    """Frozen dataclass of its arguments, each field with a docstring; its `__post_init__` raises ValueError
    for impossible values."""
    wrap: Callable[[Any, Any], Any]
    """(ParallelEnv, arguments) -> the wrapped ParallelEnv. Infos `alive`, `acting`, `action_mask` and
    `episode_metrics` pass through it."""
    batched: Callable[[Any, ObservationBounds], BatchedWrapper | None] | None = None
    """(arguments, bounds of what it is to wrap) -> its twin; None where it has none for those.
    Raises HeadwayError where those cannot be wrapped."""
    only_rewards: bool = False
    """It changes nothing but rewards, to make learning easier: it is there while learning only, and what is
    evaluated and reported is paid by the environment's own."""
    skips_steps: bool = False
    """Several steps pass in one of its own, and infos keep `acting` of the last of them only."""
    changes_actions: bool = False
    """An action means something else after it: an environment's own rules cannot play behind it."""
