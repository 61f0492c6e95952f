"""What a critic's viewpoints are paid, and when that is over."""

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
    """Rewards and their ends, from each of W viewpoints."""

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
        """Each agent's own, or the team's: that goes on until the episode ends, whoever is present."""
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
        """(T + 1, C, W): a stream begins with the step, or, in the last row, with what comes after."""
        first = trajectory.begins
        if view.team:
            first = np.broadcast_to(first.all(axis=2, keepdims=True), (*first.shape[:2], view.viewpoints))
        return np.concatenate([first, self.terminated | self.truncated])


def presence(alive: NDArray[np.bool_], view: CriticInputs) -> NDArray[np.bool_]:
    """(M, C, N) -> (M, C, W): where there is a value to speak of."""
    return np.ones((*alive.shape[:2], 1), np.bool_) if view.whole else alive


def lambda_advantages(
    trajectory: Trajectory,
    view: CriticInputs,
    values: NDArray[np.float64],
    worth: Callable[[CriticBatch], NDArray[np.float64]],
    config: AlgoConfig,
    spec: EnvSpec,
    replicas: int,
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Generalised advantages of values (T, C, W), and where there are any, (T, C, W).

    `worth` values what no step of the trajectory begins with, scenes of (M, C) -> (M, C, W): what comes
    after the last step, and the final observations of streams that were truncated.
    """
    streams = RewardStreams.of(trajectory, view)
    values = np.concatenate([values, worth(CriticBatch.after_the_last_step(trajectory))])
    endings = Truncations.of(trajectory, replicas)
    final_values = np.zeros(streams.rewards.shape)
    if len(endings):
        scene = CriticBatch.after_endings(trajectory, endings)
        final = worth(scene)
        if view.team and not view.whole:
            # A team's return goes on for agents that are gone, but no critic is trained on what these see.
            of_teammates, known = with_teammates_values(final, scene.in_joint)
            final = np.where(known, of_teammates, final)
        final_values = endings.put(final, final_values.shape)
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
