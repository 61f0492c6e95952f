"""Policies that are one at first and part later.

Independent policies learn each from its own agent's experience: of N agents each has an N-th of what a
shared policy has. Sharing first gives them what all agents learned; parting lets them specialise.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from headway.contracts import EnvSpec, Trajectory
from headway_algos.config import AlgoConfig
from headway_algos.on_policy.learner import OnPolicyLearner


class SplitLearner:
    """Learns one shared policy for `shared_until` of the training; then every policy of its own goes on from
    there, normalisers, critics and optimisers included (see `headway.contracts.Learner`)."""

    def __init__(self, config: AlgoConfig, spec: EnvSpec, seeds: Sequence[int], device: str) -> None:
        self.config = config
        shared = replace(config, policies="shared", shared_until=0.0, apart_lr=1.0)
        self.shared = OnPolicyLearner(shared, spec, seeds, device)
        self.separate = OnPolicyLearner(_with_reduced_steps(config), spec, seeds, device)
        self.is_split = False

    @property
    def policies(self) -> int:
        """K, once they have parted."""
        return self.separate.grouping.num_policies

    def acting_parameters(self) -> dict[str, NDArray[Any]]:
        """Those of each policy, as long as they are one in K equal copies."""
        if self.is_split:
            return self.separate.acting_parameters()
        shared = self.shared.acting_parameters()
        return {name: np.repeat(array, self.policies, axis=0) for name, array in shared.items()}

    def update(
        self, trajectory: Trajectory, iteration: int, progress: float
    ) -> dict[str, NDArray[np.float64]]:
        """One iteration of whichever it is time for; before the first one apart, they part."""
        if progress < self.config.shared_until:
            return self.shared.update(trajectory, iteration, progress)
        if not self.is_split:
            state = _repeat_per_policy(self.shared.state_dict(), self.separate.state_dict(), self.policies)
            self.separate.load_state_dict(state)
            self.is_split = True
        return self.separate.update(trajectory, iteration, progress)

    def state_dict(self) -> dict[str, Any]:
        """Of the learner whose time it is."""
        learner = self.separate if self.is_split else self.shared
        return {"parted": self.is_split, "learner": learner.state_dict()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Inverse of `state_dict`; raises RuntimeError where shapes differ."""
        self.is_split = bool(state["parted"])
        (self.separate if self.is_split else self.shared).load_state_dict(state["learner"])


def _with_reduced_steps(config: AlgoConfig) -> AlgoConfig:
    """The same with `apart_lr` of its learning rates."""
    share = config.apart_lr
    critic_lr = None if config.critic_lr is None else config.critic_lr * share
    return replace(
        config,
        lr=config.lr * share,
        critic_lr=critic_lr,
        kl_bound=config.kl_bound * share**2,
        critic_kl_bound=config.critic_kl_bound * share**2,
    )


def _repeat_per_policy(one: Any, like: Any, times: int) -> Any:  # noqa: ANN401 - states are nested plain values
    """A state with each tensor (R, ...) repeated into (R x times, ...) where its counterpart in `like` is so
    long; what a whole replica has only one of (a team's critic) is taken as it is."""
    if isinstance(one, Tensor):
        alike = like is None or one.shape == like.shape  # None: what a critic remembers before it saw any
        return one.clone() if alike else one.repeat_interleave(times, dim=0)
    if isinstance(one, Mapping):
        return {name: _repeat_per_policy(value, like[name], times) for name, value in one.items()}
    if isinstance(one, list):
        return [_repeat_per_policy(value, other, times) for value, other in zip(one, like, strict=True)]
    return one
