"""Classical controllers of the CAVs, for comparison. `random` is `headway.contracts.RandomRule`."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from headway.contracts import BatchedEnv, Observations
from headway_envs.merge.env import MergeBatchedEnv
from headway_envs.merge.kernel.drivers import write_human_actions
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
class HumanActions:
    """Take, of the five actions, the one closest to what a human driver would do (`write_human_actions`)."""

    prepared: "Prepared"

    def act(self, env: BatchedEnv, observed: Observations) -> NDArray[np.int64]:
        """Return the actions (C, N); `IDLE` for those that the mask forbids and for empty slots."""
        actions = np.full(observed.alive.shape, IDLE, np.int64)
        merge = _merge(env, "idm_mobil_actions")
        write_human_actions(merge.network, merge.settings, merge.world, actions)
        if observed.action_masks is None:
            return actions
        allowed = np.take_along_axis(observed.action_masks, actions[..., None], -1)[..., 0]
        return np.where(allowed, actions, IDLE)


@dataclass(frozen=True)
class IdmMobil:
    """Drive every CAV as a human driver: IDM, MOBIL, and its initial speed as the desired speed."""

    prepared: "Prepared"

    def act(self, env: BatchedEnv, observed: Observations) -> NDArray[np.int64]:
        """Return `AS_HUMAN` for every slot, an internal action outside the action space.

        It is needed because the actions include no accelerations.
        """
        _merge(env, "idm_mobil")
        return np.full(observed.alive.shape, AS_HUMAN, np.int64)


def _merge(env: BatchedEnv, rule: str) -> MergeBatchedEnv:
    if not isinstance(env, MergeBatchedEnv):
        raise TypeError(f"{rule} needs a MergeBatchedEnv, not {type(env).__name__}")
    return env
