"""Elementwise changes of rewards: SuperSuit's clip_reward_v0, and Headway's own scale_reward_v0.

SuperSuit scales rewards only by a function written in Python, which YAML cannot hold.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from headway.contracts import (
    BatchedEnv,
    BatchedWrapper,
    BatchWrapper,
    ObservationBounds,
    Observations,
    StepResult,
)
from headway.contracts.checks import require, require_finite
from headway.wrappers.supersuit_module import imported_supersuit


@dataclass(frozen=True)
class ClipReward:
    """Arguments of clip_reward_v0."""

    lower_bound: float = -1.0
    """Smallest reward, at most 0."""
    upper_bound: float = 1.0
    """Largest reward, at least 0."""

    def __post_init__(self) -> None:
        # SuperSuit clips each of the N terms that sum to a reward; all but one of them are 0.
        bounds = f"lower_bound {self.lower_bound} and upper_bound {self.upper_bound}"
        require(self.lower_bound <= 0 <= self.upper_bound, f"{bounds} must have 0 between them")


@dataclass(frozen=True)
class ScaleReward:
    """Arguments of scale_reward_v0."""

    scale: float
    """Factor of every reward."""

    def __post_init__(self) -> None:
        require_finite(self)


class ChangedRewards(BatchWrapper):
    """Changes each reward by `change`, (C, N) -> (C, N).

    `change` must map 0 to 0, so that absent agents still get 0, and must be picklable.
    """

    def __init__(
        self, inner: BatchedEnv, change: Callable[[NDArray[np.float32]], NDArray[np.floating[Any]]]
    ) -> None:
        super().__init__(inner)
        self._change = change
        self._rewards = np.zeros((inner.num_copies, inner.spec.num_agents), dtype=np.float32)

    def _advance(self, outcome: StepResult, observed: Observations) -> tuple[StepResult, Observations]:
        self._rewards[...] = self._change(outcome.rewards)
        return replace(outcome, rewards=self._rewards), observed


def batched_clip_reward(arguments: ClipReward, bounds: ObservationBounds) -> BatchedWrapper:
    """Return the batched form of clip_reward_v0."""
    clip = partial(np.clip, a_min=arguments.lower_bound, a_max=arguments.upper_bound)
    return BatchedWrapper(partial(ChangedRewards, change=clip), bounds)


def batched_scale_reward(arguments: ScaleReward, bounds: ObservationBounds) -> BatchedWrapper:
    """Return the batched form of scale_reward_v0."""
    # In float64, like the Python floats of a ParallelEnv's rewards.
    scale = partial(np.multiply, arguments.scale, dtype=np.float64)
    return BatchedWrapper(partial(ChangedRewards, change=scale), bounds)


def scale_reward(env: Any, arguments: ScaleReward) -> Any:  # noqa: ANN401 - PettingZoo comes without types
    """Return a ParallelEnv with every reward rounded to float32, as in batches, and multiplied by `scale`."""
    return imported_supersuit().reward_lambda_v0(
        env, lambda reward: float(np.float32(reward)) * arguments.scale
    )
