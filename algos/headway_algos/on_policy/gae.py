"""Generalised advantage estimation (Schulman et al. 2015, arXiv:1506.02438)."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from headway_algos.kernels.gae import write_advantages

Array = NDArray[np.float64]


def generalised_advantages(
    rewards: Array,
    values: Array,
    final_values: Array,
    terminated: NDArray[np.bool_],
    truncated: NDArray[np.bool_],
    present: NDArray[np.bool_],
    gamma: float,
    gae_lambda: float,
) -> Array:
    """Return advantages (T, C, N), given rewards (T, C, N) and values (T + 1, C, N):

        delta_t = r_t + gamma V_{t+1} (1 - terminated_t) - V_t
        A_t = delta_t + gamma lambda (1 - done_t) A_{t+1}

    After a truncated step V_{t+1} is `final_values[t]` (T, C, N), the value of the stream's last observation.

    While an agent is absent (`present` (T + 1, C, N) false) but its stream continues, its discounted rewards
    are credited to its last action before (a semi-Markov step: Sutton, Precup and Singh 1999, "Between MDPs
    and semi-MDPs"). Advantages of absent steps are 0 and values there are ignored; the value of an agent
    absent after the last step is 0. The recursion is `kernels.gae.write_advantages`.
    """
    advantages = np.empty(rewards.shape)
    given = (rewards, values, final_values, terminated, truncated, present)
    arrays: list[Any] = [np.ascontiguousarray(array).reshape(len(array), -1) for array in given]
    write: Callable[..., None] = write_advantages
    write(*arrays, gamma, gae_lambda, advantages.reshape(len(advantages), -1))
    return advantages


def last_known_values(values: Array, present: NDArray[np.bool_]) -> Array:
    """Return each agent's value (C, N) at the last of T steps, (T, C, N), at which it is present; else 0."""
    rows_since = present[::-1].argmax(axis=0)
    known = np.take_along_axis(values, len(values) - 1 - rows_since[None], axis=0)[0]
    return np.where(present.any(axis=0), known, 0)


def with_teammates_values(
    values: Array, present: NDArray[np.bool_], teams: Sequence[str]
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Return values and presence (..., N), with the values of absent agents filled in from their teammates.

    An absent agent gets the mean value of its team's agents present in its copy, if any; `teams` (N,) names
    the agents' teams. Agents with a shared reward have the same expected return; a value of 0 would make
    leaving look costly (or, with negative rewards, profitable).
    """
    values, present = values.copy(), present.copy()
    names = np.array(teams)
    for members in [np.flatnonzero(names == team) for team in set(teams)]:
        here, known = present[..., members], values[..., members]
        count = here.sum(axis=-1, keepdims=True)
        mean = np.where(here, known, 0).sum(axis=-1, keepdims=True) / np.maximum(count, 1)
        values[..., members] = np.where(here, known, mean)
        present[..., members] = here | (count > 0)
    return values, present
