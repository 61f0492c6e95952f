"""Critics: estimation of advantages, and training of value networks. The package itself imports no torch."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Protocol, TypeAlias

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    import numpy as np
    import torch
    from numpy.typing import NDArray

    from headway.contracts import EnvSpec, Trajectory
    from headway_algos.grouping import Grouping
    from headway_algos.on_policy.behaviour_policy import BehaviourPolicy
    from headway_algos.on_policy.critics.estimate import CriticEstimate


class Critic(Protocol):
    """Estimates advantages from a trajectory, and is trained on it.

    Everything carried from one iteration to the next is part of its state.
    """

    exchangeable_agents: bool
    """An agent's value depends on its own observations and rewards only, so that slots that no agent used may
    be left out."""

    def estimate(self, trajectory: Trajectory, behaviour: BehaviourPolicy, iteration: int) -> CriticEstimate:
        """Return advantages and the data that `fit` needs, without changing the critic.

        `behaviour` are the policies that acted; `iteration` selects the random stream.
        """
        ...

    def fit(self, estimate: CriticEstimate, iteration: int) -> dict[str, NDArray[np.float64]]:
        """Train the critic on the estimated returns; return metrics by name, each (R,)."""
        ...

    def update_normalisers(self, trajectory: Trajectory) -> None:
        """Include an iteration's inputs in the running statistics (once per iteration, after `fit`)."""
        ...

    def anneal(self, share: float) -> None:
        """Set the learning rate to `share` of its configured value."""
        ...

    def state_dict(self) -> dict[str, Any]:
        """Return everything needed to continue exactly: tensors, numbers, strings, lists and dicts."""
        ...

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore the result of `state_dict`, leaving `state` unchanged; RuntimeError if shapes differ."""
        ...


MakeCritic: TypeAlias = "Callable[[Any, EnvSpec, Grouping, Sequence[int], torch.device, torch.dtype], Critic]"
"""(config, environment, grouping of agents by policy, seeds of the replicas, device, dtype) -> critic."""
