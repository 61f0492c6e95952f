"""Classical controllers of the CAVs, for comparison. `random` is `headway.contracts.RandomRule`."""

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
class AlwaysLeft:
    """Change to the left as soon as the mask allows it, without regard to other vehicles."""

    prepared: "Prepared"

    def act(self, env: BatchedEnv, observed: Observations) -> NDArray[np.int64]:
        if observed.action_masks is None:
            return np.full(observed.alive.shape, LEFT, np.int64)
        return np.where(observed.action_masks[..., LEFT], LEFT, IDLE)


@dataclass(frozen=True)
class IdmMobil:
    """Drive every CAV as a human driver: IDM, MOBIL, and its initial speed as the desired speed."""

    prepared: "Prepared"

    def act(self, env: BatchedEnv, observed: Observations) -> NDArray[np.int64]:
        """Return `AS_HUMAN` for every slot, an internal action outside the action space.

        It is needed because the actions include no accelerations.
        """
        if not isinstance(env, MergeBatchedEnv):
            raise TypeError(f"idm_mobil needs a MergeBatchedEnv, not {type(env).__name__}")
        return np.full(observed.alive.shape, AS_HUMAN, np.int64)
