"""Rule that always takes the same action, for comparison."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from headway.contracts import BatchedEnv, Observations


@dataclass(frozen=True)
class ConstantAction:
    """Rule under which every agent takes the same Discrete action at every step."""

    prepared: object
    action: int

    def act(self, env: BatchedEnv, observed: Observations) -> NDArray[np.int64]:
        return np.full(observed.alive.shape, self.action, np.int64)
