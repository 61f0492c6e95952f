"""How experience is judged: each critic by name, with what it sees and how it learns."""

from collections.abc import Callable, Sequence
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray

from headway.contracts import EnvSpec, Trajectory
from headway_algos.config import AlgoConfig
from headway_algos.grouping import Grouping
from headway_algos.on_policy.behaviour_policy import BehaviourPolicy
from headway_algos.on_policy.critics.counterfactual import CounterfactualCritic
from headway_algos.on_policy.critics.estimate import CriticEstimate
from headway_algos.on_policy.critics.value import ValueCritic


class Critic(Protocol):
    """Turns experience into advantages, and learns from it to judge better. Whatever it carries from one
    iteration to the next is in its state."""

    def estimate(self, trajectory: Trajectory, behaviour: BehaviourPolicy, iteration: int) -> CriticEstimate:
        """Advantages, and what `fit` learns from; changes nothing. `behaviour` is of the policies that
        acted; `iteration` is for random draws."""
        ...

    def fit(self, estimate: CriticEstimate, iteration: int) -> dict[str, NDArray[np.float64]]:
        """Learn what values should have been. Returns metrics by name, each (R,)."""
        ...

    def update_normalisers(self, trajectory: Trajectory) -> None:
        """Add an iteration's inputs to the normalisers' statistics (once an iteration, after learning)."""
        ...

    def anneal(self, share: float) -> None:
        """Take steps of `share` of their configured size from now on."""
        ...

    def state_dict(self) -> dict[str, Any]:
        """All that it carries on: tensors, numbers, strings, lists and dicts."""
        ...

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Inverse of `state_dict`; leaves `state` as it is. Raises RuntimeError where shapes differ."""
        ...


MakeCritic = Callable[[AlgoConfig, EnvSpec, Grouping, Sequence[int], torch.device, torch.dtype], Critic]
"""(config, environment, which agent follows which policy, seeds of the replicas, device, precision)"""

CRITICS: dict[str, MakeCritic] = {
    "local": ValueCritic,
    "central": ValueCritic,
    "counterfactual": CounterfactualCritic,
}
