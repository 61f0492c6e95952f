"""Training of one shared policy that is later split into separate ones.

With N independent policies each sees 1/N of the data that a shared policy would. Training starts with a
shared policy, on all agents' data; after the split the policies can specialise.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from headway.contracts import EnvSpec, HeadwayError, Trajectory
from headway_algos.batches.nested_states import map_tensors
from headway_algos.config import SimultaneousConfig
from headway_algos.on_policy.warm_start import WarmStartLearner


class SplitLearner:
    """A `headway.contracts.Learner` of one shared policy until `shared_until`, of K separate ones afterwards.

    At the split each policy gets a copy of the shared one, with its normalisers, critic and optimisers.
    """

    def __init__(self, config: SimultaneousConfig, spec: EnvSpec, seeds: Sequence[int], device: str) -> None:
        self.config = config
        shared = replace(config, policies="shared", agent_id=False, shared_until=0.0, apart_lr=1.0)
        self.shared = WarmStartLearner(shared, spec, seeds, device)
        self.separate = WarmStartLearner(config, spec, seeds, device, config.apart_lr)
        self.is_split = False

    @property
    def policies(self) -> int:
        """K: number of policies after the split."""
        return self.separate.grouping.num_policies

    def acting_parameters(self) -> dict[str, NDArray[Any]]:
        """Return the acting parameters of K policies; K equal copies before the split."""
        if self.is_split:
            return self.separate.acting_parameters()
        shared = self.shared.acting_parameters()
        return {name: np.repeat(array, self.policies, axis=0) for name, array in shared.items()}

    def update(
        self, trajectory: Trajectory, iteration: int, progress: float
    ) -> dict[str, NDArray[np.float64]]:
        """Update the shared policy, or, once `progress` reaches `shared_until`, the separate ones."""
        if progress < self.config.shared_until:
            return self.shared.update(trajectory, iteration, progress)
        if not self.is_split:
            state = _repeat_per_policy(self.shared.state_dict(), self.separate.state_dict(), self.policies)
            self.separate.load_state_dict(state)
            self.is_split = True
        return self.separate.update(trajectory, iteration, progress)

    def anchor(self, kl_coeff: float, critic_only: bool) -> None:
        """Anchor both learners: the separate policies take over the shared policy's start at the split."""
        for learner in (self.shared, self.separate):
            learner.anchor(kl_coeff, critic_only)

    def imitate(
        self, trajectory: Trajectory, iteration: int, iterations: int
    ) -> dict[str, NDArray[np.float64]]:
        """Let the shared policy imitate the actions. A rule acts before any split."""
        return self.shared.imitate(trajectory, iteration, iterations)

    def replay_state(self) -> dict[str, Any] | None:
        """Return the rule's decisions that the shared policy keeps for imitation; None if there are none."""
        return self.shared.replay_state()

    def load_replay_state(self, state: dict[str, Any]) -> None:
        """Continue from the result of `replay_state`."""
        self.shared.load_replay_state(state)

    def start_from(self, state: dict[str, Any], replica: int, replicas: int, with_critic: bool) -> list[str]:
        """Raise HeadwayError: training begins with a shared policy, which another run's policies cannot
        replace."""
        raise HeadwayError("algo.shared_until begins with a shared policy, not with those of start.run")

    def state_dict(self) -> dict[str, Any]:
        """Return the state of the current learner, and whether the policies have been split."""
        learner = self.separate if self.is_split else self.shared
        return {"parted": self.is_split, "learner": learner.state_dict()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore the result of `state_dict`; raises RuntimeError if shapes differ."""
        self.is_split = bool(state["parted"])
        (self.separate if self.is_split else self.shared).load_state_dict(state["learner"])


def _repeat_per_policy(one: dict[str, Any], like: dict[str, Any], times: int) -> dict[str, Any]:
    """Repeat each tensor (R, ...) of a state to (R x times, ...) if its counterpart in `like` is that long.

    Tensors with one entry per replica in both, such as a team's critic, are copied unchanged.
    """

    def repeated(tensor: Tensor, other: Tensor | None) -> Tensor:
        # `other` is None for the hidden states of a critic before its first update.
        alike = other is None or tensor.shape == other.shape
        return tensor.clone() if alike else tensor.repeat_interleave(times, dim=0)

    result: dict[str, Any] = map_tensors(repeated, one, like)
    return result
