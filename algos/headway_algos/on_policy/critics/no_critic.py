"""Policy gradients without a critic."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from headway.contracts import EnvSpec, Trajectory
from headway_algos.batches.stream_ends import return_ends
from headway_algos.config import AlgoConfig
from headway_algos.grouping import Grouping
from headway_algos.on_policy.behaviour_policy import BehaviourPolicy
from headway_algos.on_policy.critics.estimate import CriticEstimate
from headway_algos.on_policy.gae import generalised_advantages


class NoCritic:
    """Advantages are discounted returns (REINFORCE: Williams 1992, doi 10.1007/BF00992696).

    `normalise_advantages` standardises them, which subtracts a constant baseline. A return ends with its
    stream, or the team's episode, and with the iteration: rewards after a truncation or after the last step
    count as zero. An iteration should therefore contain whole episodes.
    """

    exchangeable_agents = True

    def __init__(
        self,
        config: AlgoConfig,
        spec: EnvSpec,
        grouping: Grouping,
        seeds: Sequence[int],
        device: torch.device,
        dtype: torch.dtype,
    ) -> None:
        self._gamma, self._spec, self._empty = config.gamma, spec, torch.empty(0, device=device, dtype=dtype)

    def estimate(self, trajectory: Trajectory, behaviour: BehaviourPolicy, iteration: int) -> CriticEstimate:
        """Return discounted returns as advantages, with values of 0."""
        rewards = trajectory.rewards.astype(np.float64)
        zeros = np.zeros((len(rewards) + 1, *rewards.shape[1:]))
        ends = return_ends(trajectory, self._spec)
        returns = generalised_advantages(
            rewards, zeros, zeros[:-1], *ends, trajectory.alive, self._gamma, gae_lambda=1.0
        )
        return CriticEstimate(returns, zeros[:-1], returns, trajectory.alive[:-1], self._empty)

    def fit(self, estimate: CriticEstimate, iteration: int) -> dict[str, NDArray[np.float64]]:
        """Return no metrics: there is nothing to train."""
        return {}

    def update_normalisers(self, trajectory: Trajectory) -> None:
        """Do nothing."""

    def anneal(self, share: float) -> None:
        """Do nothing."""

    def state_dict(self) -> dict[str, Any]:
        """Return an empty state."""
        return {}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Do nothing."""
