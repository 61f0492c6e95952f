"""Fixed ways to drive the CAVs, to compare with. `random` is `headway.contracts.RandomRule`."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from headway.contracts import BatchedEnv, Observations
from headway_envs.merge.env import MergeBatchedEnv
from headway_envs.merge.kernel.layout import AS_HUMAN, IDLE, LEFT

if TYPE_CHECKING:
    from headway_envs.merge.prepared import Prepared


@dataclass(frozen=True)
class Idle:
    """Keep the lane and the speed: whoever is on a ramp hits its end."""

    prepared: "Prepared"

    def act(self, env: BatchedEnv, observed: Observations) -> NDArray[np.int64]:
        return np.full(observed.alive.shape, IDLE, np.int64)


@dataclass(frozen=True)
class AlwaysLeft:
    """Change to the left as soon as it is allowed, whoever is there."""

    prepared: "Prepared"

    def act(self, env: BatchedEnv, observed: Observations) -> NDArray[np.int64]:
        if observed.action_masks is None:
            return np.full(observed.alive.shape, LEFT, np.int64)
        return np.where(observed.action_masks[..., LEFT], LEFT, IDLE)


@dataclass(frozen=True)
class IdmMobil:
    """Every CAV drives as a human driver: IDM, MOBIL, and its first speed as the desired one."""

    prepared: "Prepared"

    def act(self, env: BatchedEnv, observed: Observations) -> NDArray[np.int64]:
        """Not an action of the action space, which has no accelerations: only this environment knows it."""
        if not isinstance(env, MergeBatchedEnv):
            raise TypeError(f"idm_mobil needs a MergeBatchedEnv, not {type(env).__name__}")
        return np.full(observed.alive.shape, AS_HUMAN, np.int64)
