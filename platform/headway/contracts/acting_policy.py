"""Policies as workers run them: from observations to actions, in numpy only."""

from collections.abc import Mapping
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from headway.contracts.environment import Observations

Parameters = Mapping[str, NDArray[Any]]
"""Named arrays, each with leading axis P (policies of all replicas, replica-major) where an acting policy
reads them."""


class ActingPolicy(Protocol):
    """Inference on a learner's policies, without torch.

    Must be picklable, since every worker gets a copy. Its log-probabilities must equal those of the learner's
    network within 1e-5. A policy whose results for a copy have the same bits in a block of any size sets the
    class attribute `any_block` to True: all copies of a process are then computed at once.
    """

    def parameter_shapes(self, replicas: int) -> dict[str, tuple[tuple[int, ...], np.dtype[Any]]]:
        """Return the shape and dtype of every array that `act` reads, for R = `replicas`."""
        ...

    def noise(self, generator: np.random.Generator, steps: int) -> NDArray[np.float64]:
        """Draw the random numbers of one copy's agents for `steps` steps, shape (T, N, ...).

        All draws come from `generator`. The trailing axes are the policy's own.
        """
        ...

    def act(
        self, parameters: Parameters, observed: Observations, noise: NDArray[np.float64] | None
    ) -> tuple[NDArray[Any], NDArray[np.float64]]:
        """Return actions and their log-probabilities for a block of C copies.

        The block contains equally many copies per replica, replica-major. Actions are shaped as
        `BatchedEnv.step` takes them, log-probabilities are (C, N). `noise` (C, N, ...) is one step of the
        method `noise`; None: act greedily, by the mode of the distribution. Rows of agents not alive are
        unspecified in arguments and results.
        """
        ...


@runtime_checkable
class RecurrentPolicy(ActingPolicy, Protocol):
    """An acting policy with a recurrent network: each agent has a hidden state of M components.

    The caller keeps the hidden states between steps. It sets them to 0 where an agent's stream begins and
    where the agent was terminated or truncated.
    """

    @property
    def hidden_size(self) -> int:
        """M, at least 1."""
        ...

    @property
    def hidden_dtype(self) -> np.dtype[Any]:
        """Dtype of the hidden states."""
        ...

    def act_from(
        self,
        parameters: Parameters,
        observed: Observations,
        hidden_states: NDArray[Any],
        noise: NDArray[np.float64] | None,
    ) -> tuple[NDArray[Any], NDArray[np.float64], NDArray[Any]]:
        """Return actions, log-probabilities and the next hidden states.

        Like `ActingPolicy.act`, but starting from `hidden_states` (C, N, M). The third result has the same
        shape; rows of agents not alive keep their hidden state.
        """
        ...


def hidden_size(policy: ActingPolicy) -> int:
    """Return M, the length of each agent's hidden state; 0 for a policy without recurrence."""
    return policy.hidden_size if isinstance(policy, RecurrentPolicy) else 0
