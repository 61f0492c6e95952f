"""How a worker turns observations into actions, without torch."""

from collections.abc import Mapping
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from headway.contracts.environment import Observed

Parameters = Mapping[str, NDArray[Any]]
"""Arrays by name, each with leading axis P (policies of all replicas, replica-major)."""


class ActingPolicy(Protocol):
    """The numpy twin of a learner's policies: picklable, and equal to it within 1e-5 in log-probability."""

    def parameter_shapes(self, replicas: int) -> dict[str, tuple[tuple[int, ...], np.dtype[Any]]]:
        """Shape and type of every array that `act` needs."""
        ...

    def noise(self, generator: np.random.Generator, steps: int) -> NDArray[np.float64]:
        """The random numbers that one copy's agents use in `steps` steps: (T, N, ...)."""
        ...

    def act(
        self, parameters: Parameters, observed: Observed, noise: NDArray[np.float64] | None
    ) -> tuple[NDArray[Any], NDArray[np.float64]]:
        """Actions and their log-probabilities (C, N) for a block of copies, as many of each replica
        (replica-major). Noise (C, N, ...); None acts greedily (the mode of the distribution)."""
        ...
