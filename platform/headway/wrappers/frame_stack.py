"""The last observations side by side: SuperSuit's frame_stack_v1 and frame_stack_v2 in batched form."""

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
from headway.contracts.checks import require_value


@dataclass(frozen=True)
class FrameStack:
    """Arguments of frame_stack_v1 and frame_stack_v2."""

    stack_size: int = 4
    """Number of observations side by side, the newest last."""
    stack_dim: int = -1
    """Axis along which images are stacked, 0 or -1; vectors have one axis only."""

    def __post_init__(self) -> None:
        require_value(self, "stack_size", self.stack_size >= 1, "must be at least 1")
        require_value(self, "stack_dim", self.stack_dim in (0, -1), "must be 0 or -1")


class FrameStackBatch(BatchWrapper):
    """Stacks of F frames: observations (C, N, F x D).

    Frames before the first one of an agent's stream are zeros (frame_stack_v1) or the first one repeated
    (frame_stack_v2, `repeat_first`), also when a new agent takes a slot in the step in which another leaves
    it. A slot that an agent has just left is stacked as zeros. Other rows of absent agents are stacked
    unchanged: they must be finite if those agents return.
    """

    def __init__(self, inner: BatchedEnv, size: int, repeat_first: bool = False) -> None:
        spec = inner.spec
        copies, n, d = inner.num_copies, spec.num_agents, spec.observation_size
        features = tuple(
            replace(feature, name=f"{feature.name}[t-{age}]" if age else f"{feature.name}[t]")
            for age in reversed(range(size))
            for feature in spec.observation_features
        )
        super().__init__(inner, replace(spec, observation_size=size * d, observation_features=features))
        self._repeat_first = repeat_first
        self._frames = np.zeros((copies, n, size, d), dtype=np.float32)
        self._finals = np.zeros_like(self._frames)

    def snapshot(self) -> Any:  # noqa: ANN401 - the contract's type
        return {"inner": self.inner.snapshot(), "frames": self._frames.copy()}

    def restore(self, snapshot: Any) -> Observations:  # noqa: ANN401 - the contract's type
        self.inner_observed = self.inner.restore(snapshot["inner"])
        self._frames[:] = snapshot["frames"]
        return self._stacked(self.inner_observed)

    def _begin(self, observed: Observations) -> Observations:
        self._push(observed, np.ones(observed.alive.shape, dtype=np.bool_))
        return self._stacked(observed)

    def _advance(self, outcome: StepResult, observed: Observations) -> tuple[StepResult, Observations]:
        over = outcome.terminated | outcome.truncated
        # Before `_push`: `observed` already belongs to the next episode where one ended.
        if over.any():
            self._finals[over, :-1] = self._frames[over, 1:]
            self._finals[over, -1] = outcome.final_observations[over]
        self._push(observed, over)
        # The row of a slot that an agent has left may still hold that agent's last observation.
        self._frames[over & ~observed.alive & ~outcome.episode_ended[:, None]] = 0
        finals = self._finals.reshape(*over.shape, -1)
        return replace(outcome, final_observations=finals), self._stacked(observed)

    def _push(self, observed: Observations, beginning: NDArray[np.bool_]) -> None:
        """Append a frame. Where `beginning` (C, N) is set, overwrite the frames before it."""
        frames = self._frames
        frames[:, :, :-1] = frames[:, :, 1:]
        frames[:, :, -1] = observed.observations
        if beginning.any():
            frames[beginning, :-1] = frames[beginning, -1:] if self._repeat_first else 0

    def _stacked(self, observed: Observations) -> Observations:
        return replace(observed, observations=self._frames.reshape(*observed.alive.shape, -1))


def batched_frame_stack(
    repeat_first: bool, arguments: FrameStack, bounds: ObservationBounds
) -> BatchedWrapper:
    """Return the batched form of frame_stack_v1 or, with `repeat_first`, frame_stack_v2."""
    size = arguments.stack_size
    stacked = replace(bounds, low=np.tile(bounds.low, size), high=np.tile(bounds.high, size))
    return BatchedWrapper(partial(FrameStackBatch, size=size, repeat_first=repeat_first), stacked)
