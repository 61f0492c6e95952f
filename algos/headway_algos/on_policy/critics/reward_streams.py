"""Rewards and ends of returns from a critic's viewpoints, and lambda-advantages on them."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from headway.contracts import EnvSpec, Trajectory
from headway_algos.batches.critic_batch import CriticBatch
from headway_algos.batches.stream_ends import Truncations, return_ends
from headway_algos.on_policy.critics.config import CriticConfig
from headway_algos.on_policy.critics.critic_inputs import CriticInputs
from headway_algos.on_policy.gae import generalised_advantages, last_known_values, with_teammates_values


def presence(alive: NDArray[np.bool_], critic_inputs: CriticInputs) -> NDArray[np.bool_]:
    """Return where a value exists, (M, C, W), given the alive mask (M, C, N)."""
    return np.ones((*alive.shape[:2], 1), np.bool_) if critic_inputs.single else alive


def stream_begins(trajectory: Trajectory, critic_inputs: CriticInputs) -> NDArray[np.bool_]:
    """Return (T + 1, C, W): an agent's stream, or a team's episode, begins with the step.

    The last row is the time right after the last step.
    """
    if critic_inputs.single:
        return np.concatenate([trajectory.episode_begins, trajectory.episode_ended])[..., None]
    return np.concatenate([trajectory.begins, trajectory.terminated | trajectory.truncated])


def lambda_advantages(
    trajectory: Trajectory,
    critic_inputs: CriticInputs,
    values: NDArray[np.float64],
    observed_values: NDArray[np.float64],
    value_of: Callable[[CriticBatch], NDArray[np.float64]],
    config: CriticConfig,
    spec: EnvSpec,
    replicas: int,
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Return generalised advantages (T, C, W) for values (T, C, W), and a mask (T, C, W) of where they exist.

    `value_of` computes values (M, C, W) of other time points: after the last step, and at the final
    observations of truncated streams. `observed_values` (T, C, W) are the values before an action is chosen.

    If an agent is absent after the last step but its return continues, it bootstraps from the mean value of
    its present teammates or, without any, from the value of its own last observation. A value of 0 would make
    absence look costly (or, with negative rewards, profitable), and more so the shorter the rollout; leaving
    out the steps since that observation would select against long absences.
    """
    used = values.shape[2]
    rewards = trajectory.rewards[:, :, :used].astype(np.float64)
    terminated, truncated = (ends[:, :, :used] for ends in return_ends(trajectory, spec))
    present = presence(trajectory.alive, critic_inputs)
    # Trailing slots that were never alive may have been left out of the trajectory.
    teams = () if critic_inputs.single else spec.teams[:used]
    values = np.concatenate([values, value_of(CriticBatch.after_last_step(trajectory))])
    truncations = Truncations.of(trajectory, replicas)
    final_values = np.zeros(rewards.shape)
    if len(truncations):
        batch = CriticBatch.after_truncations(trajectory, truncations)
        final = value_of(batch)
        if teams:
            # A team's return continues for agents that have left, but no critic is trained on their
            # observations.
            of_teammates, known = with_teammates_values(final, batch.in_joint, teams)
            final = np.where(known, of_teammates, final)
        final_values = truncations.put(final, final_values.shape)
    # Where the iteration ends but the return does not, an absent agent needs a value to bootstrap from.
    here, known = present[:-1], present[-1]
    if not known.all():
        if teams:
            values[-1], known = with_teammates_values(values[-1], known, teams)
        values[-1] = np.where(known, values[-1], last_known_values(observed_values, here))
        present = np.concatenate([here, np.ones_like(present[-1:])])
    advantages = generalised_advantages(
        rewards, values, final_values, terminated, truncated, present, config.gamma, config.gae_lambda
    )
    return advantages, here
