"""A simple fixed rule, for comparison."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from headway.contracts import BatchedEnv, Observations
from headway_envs.bus_published.env import BusPublishedBatchedEnv
from headway_envs.bus_published.kernel.layout import DETOUR_SHARE, FUEL_UNIT_S, MOVE, SERVICE_CENTER

if TYPE_CHECKING:
    from headway_envs.bus_published.prepared import Prepared


@dataclass(frozen=True)
class MoveWithService:
    """Baseline that moves, and goes to service when its uptime is low and its fuel lasts for the detour."""

    prepared: "Prepared"
    below: float
    """Uptime below which a bus goes to service."""

    def act(self, env: BatchedEnv, observed: Observations) -> NDArray[np.int64]:
        """Return the actions (C, N). Raises TypeError for any other environment."""
        if not isinstance(env, BusPublishedBatchedEnv):
            raise TypeError(f"move_with_service needs a BusPublishedBatchedEnv, not {type(env).__name__}")
        net, buses = env.network, env.world.buses
        stop = net.route_stop[net.route_first[buses["route"]] + buses["place"]]
        way_s = DETOUR_SHARE * net.detour_s[stop, env.world.days["centre"][:, None]]
        due = (buses["uptime"] < self.below) & (buses["fuel"] >= way_s / FUEL_UNIT_S)
        return np.where(due, SERVICE_CENTER, MOVE).astype(np.int64)
