"""Generalised advantage estimation (Schulman et al. 2015, arXiv:1506.02438), counterfactual advantages."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

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
    absent after the last step is 0. A reward that is NaN or infinite counts as 0.
    """
    rewards = np.where(np.isfinite(rewards), rewards, 0)
    advantages = np.zeros_like(rewards)
    next_value = np.where(present[-1], values[-1], 0)
    next_advantage = np.zeros_like(next_value)
    for t in range(rewards.shape[0] - 1, -1, -1):
        ended = terminated[t] | truncated[t]
        after = np.where(ended, np.where(truncated[t] & ~terminated[t], final_values[t], 0), next_value)
        returns = rewards[t] + gamma * after
        carried = np.where(ended, 0, next_advantage)
        delta = returns - np.where(present[t], values[t], 0)
        advantages[t] = np.where(present[t], delta + gamma * gae_lambda * carried, 0)
        next_value = np.where(present[t], values[t], returns)
        next_advantage = np.where(present[t], advantages[t], gamma * carried)
    return advantages


def with_teammates_values(
    values: Array, present: NDArray[np.bool_], teams: Sequence[str] = ()
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Return values and presence (..., N), filled in for absent agents.

    Such an agent gets the mean value of the agents present in its copy, of its own team if `teams` (N,) names
    the agents' teams. Agents with a shared reward expect the same return; a value of 0 would make leaving
    look costly (or, with negative rewards, profitable).
    """
    values, present = values.copy(), present.copy()
    names = np.array(teams)
    for members in [slice(None)] if not teams else [np.flatnonzero(names == team) for team in set(teams)]:
        here, known = present[..., members], values[..., members]
        count = here.sum(axis=-1, keepdims=True)
        mean = np.where(here, known, 0).sum(axis=-1, keepdims=True) / np.maximum(count, 1)
        values[..., members] = np.where(here, known, mean)
        present[..., members] = here | (count > 0)
    return values, present


def counterfactual_advantages(
    action_values: Array, actions: NDArray[np.int64], probabilities: Array, present: NDArray[np.bool_]
) -> Array:
    """Return A^a = Q(s, u) - sum_u' pi(u'|o^a) Q(s, (u^-a, u')), (T, C, N), 0 where absent.

    Equation 4 of Foerster et al. 2018, arXiv:1705.08926. `action_values` (T, C, N, A) are Q of each own
    action, `actions` (T, C, N) those taken, `probabilities` (T, C, N, A) the policy's.
    """
    taken = np.take_along_axis(action_values, actions[..., None], axis=-1)[..., 0]
    baseline = (probabilities * action_values).sum(axis=-1)
    return np.where(present, taken - baseline, 0)
