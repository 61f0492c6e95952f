"""How a worker turns observations into actions, without torch."""

from collections.abc import Mapping
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from headway.contracts.environment import Observations

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
        self, parameters: Parameters, observed: Observations, noise: NDArray[np.float64] | None
    ) -> tuple[NDArray[Any], NDArray[np.float64]]:
        """Actions and their log-probabilities (C, N) for a block of copies, as many of each replica
        (replica-major). Noise (C, N, ...); None acts greedily (the mode of the distribution)."""
        ...


@runtime_checkable
class RecurrentPolicy(ActingPolicy, Protocol):
    """An acting policy whose agents remember what they observed before, M numbers each.

    Whoever plays it keeps these numbers from step to step: zeros where an agent's stream begins, and again
    where it was terminated or truncated.
    """

    @property
    def hidden_size(self) -> int:
        """M, at least 1."""
        ...

    @property
    def hidden_dtype(self) -> np.dtype[Any]:
        """Of the numbers remembered."""
        ...

    def act_from(
        self,
        parameters: Parameters,
        observed: Observations,
        memory: NDArray[Any],
        noise: NDArray[np.float64] | None,
    ) -> tuple[NDArray[Any], NDArray[np.float64], NDArray[Any]]:
        """As `act`, from what is remembered (C, N, M); third, what is remembered then, (C, N, M): where an
        agent is not alive, what it was."""
        ...


def hidden_size(policy: ActingPolicy) -> int:
    """M: numbers that each agent remembers; 0 for a policy without memory."""
    return policy.hidden_size if isinstance(policy, RecurrentPolicy) else 0
