"""Conversion of Box actions from the units of policies to those of the environment."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from headway.contracts import BatchedEnv, BatchWrapper, Box, EnvSpec, Observations, StepResult


class ScaledActions(BatchWrapper):
    """Maps each component affinely from the bounds of `spec` to those of the inner environment.

    Actions outside the bounds stay outside, for the environment to clip.
    """

    def __init__(self, inner: BatchedEnv, spec: EnvSpec) -> None:
        super().__init__(inner, spec)
        own, given = inner.spec.action_space, spec.action_space
        assert isinstance(own, Box)
        assert isinstance(given, Box)
        self._scale, self._offset = given.scaling_to(own)

    def step(self, actions: NDArray[Any]) -> tuple[StepResult, Observations]:
        return super().step((self._scale * actions + self._offset).astype(np.float32))

    def in_policy_units(self, actions: NDArray[Any]) -> NDArray[np.float32]:
        """Return actions of the inner environment in the units of policies."""
        return ((actions - self._offset) / self._scale).astype(np.float32)
