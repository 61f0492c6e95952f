"""Wrapper entries: everything the platform needs to know about a named wrapper.

Third parties register theirs by entry point (`headway.wrappers`), a mapping from name to entry.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from headway.contracts.environment import BatchedEnv


@dataclass(frozen=True)
class ObservationBounds:
    """Bounds of what every agent observes: a float32 vector of D components."""

    agents: tuple[str, ...]
    """Names of the N agents, in array order."""
    low: NDArray[np.float32]
    """(D,): lower bounds; -inf where there is none."""
    high: NDArray[np.float32]
    """(D,): upper bounds; inf where there is none."""


@dataclass(frozen=True)
class BatchedWrapper:
    """The batched form of a wrapper. Its results must equal those of the PettingZoo form to the last bit."""

    wrap: Callable[[BatchedEnv], BatchedEnv]
    """(batched environment) -> wrapped environment. Must be picklable.

    Input rows of agents not alive hold what a ParallelEnv shows such agents, zeros for a native environment.
    The result has two attributes that rules use: `inner`, the environment given, and `inner_observed`, its
    last observations.
    """
    bounds: ObservationBounds
    """Bounds of the wrapped environment's observations."""


@dataclass(frozen=True)
class WrapperEntry:
    """A named wrapper."""

    summary: str
    """One line for `headway list wrappers`."""
    config: type
    """Frozen dataclass of the wrapper's arguments, each field with a docstring. `__post_init__` raises
    ValueError for impossible values."""
    wrap: Callable[[Any, Any], Any]
    """(ParallelEnv, arguments) -> wrapped ParallelEnv.

    The infos `alive`, `acting`, `action_mask`, `slot_ended` and `episode_metrics` must pass through
    unchanged.
    """
    batched: Callable[[Any, ObservationBounds], BatchedWrapper | None] | None = None
    """(arguments, bounds of the environment to wrap) -> batched form, or None if there is none for these.

    Raises HeadwayError if an environment with these bounds cannot be wrapped. The field itself is None if the
    wrapper has no batched form.
    """
    only_rewards: bool = False
    """The wrapper changes nothing but rewards. It is then used in training only; evaluation and reports use
    the environment's own reward."""
    skips_steps: bool = False
    """One step of the wrapped environment is several steps of the inner one, and infos keep `acting` of the
    last of these only."""
    changes_actions: bool = False
    """Actions have another meaning after wrapping, so that the environment's own rules cannot be played."""
