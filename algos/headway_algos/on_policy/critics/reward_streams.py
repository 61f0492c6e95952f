"""Rewards and stream ends of a critic's viewpoints, and lambda-advantages on them."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from headway.contracts import EnvSpec, Trajectory
from headway_algos.batches.critic_batch import CriticBatch
from headway_algos.batches.layout import Truncations
from headway_algos.config import AlgoConfig
from headway_algos.on_policy.critics.critic_inputs import CriticInputs
from headway_algos.on_policy.gae import generalised_advantages, with_teammates_values


@dataclass(frozen=True)
class RewardStreams:
    """Rewards, stream ends and presence for W viewpoints per copy."""

    rewards: NDArray[np.float64]
    """(T, C, W)"""
    terminated: NDArray[np.bool_]
    """(T, C, W)"""
    truncated: NDArray[np.bool_]
    """(T, C, W)"""
    present: NDArray[np.bool_]
    """(T + 1, C, W)"""

    @classmethod
    def of(cls, trajectory: Trajectory, view: CriticInputs) -> "RewardStreams":
        """Return each agent's streams, or the team's, which lasts until the episode ends."""
        rewards = trajectory.rewards.astype(np.float64)
        terminated, truncated = trajectory.terminated, trajectory.truncated
        if view.team:
            ended = np.logical_or(terminated, truncated).all(axis=2, keepdims=True)
            terminated = np.array(terminated.all(axis=2, keepdims=True))
            truncated = np.logical_and(ended, ~terminated)
            rewards = rewards[:, :, : view.viewpoints]
            terminated, truncated = (np.broadcast_to(a, rewards.shape) for a in (terminated, truncated))
        return cls(rewards, terminated, truncated, presence(trajectory.alive, view))

    def begins(self, trajectory: Trajectory, view: CriticInputs) -> NDArray[np.bool_]:
        """Return (T + 1, C, W): a stream begins with the step or, in the last row, right after it."""
        first = trajectory.begins
        if view.team:
            first = np.broadcast_to(first.all(axis=2, keepdims=True), (*first.shape[:2], view.viewpoints))
        return np.concatenate([first, self.terminated | self.truncated])


def presence(alive: NDArray[np.bool_], view: CriticInputs) -> NDArray[np.bool_]:
    """Return where a value exists, (M, C, W), given the alive mask (M, C, N)."""
    return np.ones((*alive.shape[:2], 1), np.bool_) if view.single else alive


def lambda_advantages(
    trajectory: Trajectory,
    view: CriticInputs,
    values: NDArray[np.float64],
    value_of: Callable[[CriticBatch], NDArray[np.float64]],
    config: AlgoConfig,
    spec: EnvSpec,
    replicas: int,
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Return generalised advantages (T, C, W) for values (T, C, W), and where they exist (T, C, W).

    `value_of` computes values (M, C, W) of other time points: after the last step, and at the final
    observations of truncated streams.
    """
    streams = RewardStreams.of(trajectory, view)
    values = np.concatenate([values, value_of(CriticBatch.after_last_step(trajectory))])
    truncations = Truncations.of(trajectory, replicas)
    final_values = np.zeros(streams.rewards.shape)
    if len(truncations):
        batch = CriticBatch.after_truncations(trajectory, truncations)
        final = value_of(batch)
        if view.team and not view.single:
            # A team's return continues for agents that are gone, but no critic is trained on what they
            # observe.
            of_teammates, known = with_teammates_values(final, batch.in_joint)
            final = np.where(known, of_teammates, final)
        final_values = truncations.put(final, final_values.shape)
    present = streams.present
    if (spec.shared_reward or spec.shared_in_groups) and not present[-1].all():
        # Trailing slots that were never alive may have been left out of the trajectory.
        teams = () if spec.shared_reward else spec.groups[: present.shape[2]]
        values[-1], awaiting = with_teammates_values(values[-1], present[-1], teams)
        present = np.concatenate([present[:-1], awaiting[None]])
    advantages = generalised_advantages(
        streams.rewards, values, final_values, streams.terminated, streams.truncated, present,
        config.gamma, config.gae_lambda,
    )  # fmt: skip
    return advantages, present[:-1]
