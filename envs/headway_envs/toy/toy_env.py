"""Base class of the toy environments."""

from abc import ABC, abstractmethod

import numpy as np
from numpy.typing import NDArray

from headway.contracts import EnvSpec, Observations
from headway.contracts.environment import step_arrays, step_result


class ToyEnv(ABC):
    """Implementation of `headway.contracts.BatchedEnv`, except `step` and snapshots.

    `_episode` and `_step` count for environments whose copies are all at the same step of the same episode.
    """

    def __init__(self, spec: EnvSpec, copies: int) -> None:
        """Allocate the arrays: zeros, and every agent alive and acting."""
        self._spec = spec
        self._seeds = np.zeros(copies, dtype=np.uint64)
        self._episode = 0
        self._step = 0
        arrays = step_arrays(spec, copies)
        arrays["alive"].fill(True)
        arrays["acting"].fill(True)
        masks = arrays["masks"] if spec.has_action_mask else None
        self._observed = Observations(arrays["observations"], arrays["states"], arrays["alive"], masks)
        self._outcome = step_result(arrays)

    @property
    def spec(self) -> EnvSpec:
        return self._spec

    @property
    def num_copies(self) -> int:
        return len(self._seeds)

    def reset(self, seeds: NDArray[np.uint64]) -> Observations:
        self._seeds[:] = seeds
        self._begin(episode=0)
        return self._show()

    def close(self) -> None:
        """Do nothing: the environment holds no open resources."""
        return

    @abstractmethod
    def _begin(self, episode: int) -> None:
        """Begin an episode of every copy."""

    @abstractmethod
    def _show(self) -> Observations:
        """Return the observations of the current step."""
