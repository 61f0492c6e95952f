"""Holding rules with thresholds, and baselines without holding.

All but `AlwaysMove` also send buses to the service centre in time, as a dispatcher would
(`FleetState.due_for_service`). With `control=holding` the environment does that under every controller.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from headway.contracts import BatchedEnv, Observations
from headway_envs.bus.kernel.layout import MOVE, SERVICE_CENTER, WAIT
from headway_envs.bus.rules.fleet_state import FleetState, Floats

if TYPE_CHECKING:
    from headway_envs.bus.prepared import Prepared


@dataclass(frozen=True)
class HoldingRule(ABC):
    """A rule that decides every minute whether to hold or, with `control=holding`, once for how long."""

    prepared: "Prepared"

    @abstractmethod
    def hold(self, fleet: FleetState) -> NDArray[np.bool_]:
        """Return which buses are held for another `hold_s` at their next event, (C, N)."""

    @abstractmethod
    def seconds(self, fleet: FleetState) -> Floats:
        """Return the holding times, s, from when buses are ready to leave, (C, N); any number, or NaN for
        0."""

    def act(self, env: BatchedEnv, observed: Observations) -> NDArray[Any]:
        """Return WAIT where held, else MOVE, with SERVICE_CENTER for buses due for service; or the action
        nearest to the holding time."""
        fleet, config = FleetState(env), self.prepared.config
        if config.holds:
            seconds = np.nan_to_num(self.seconds(fleet)).clip(0.0, config.max_hold_s)
            if config.hold_levels:
                return np.rint(seconds / config.hold_step_s).astype(np.int64)
            return seconds[..., None].astype(np.float32)
        actions = np.where(self.hold(fleet), WAIT, MOVE).astype(np.int64)
        if fleet.terminal.any():
            actions[fleet.terminal & fleet.due_for_service] = SERVICE_CENTER
        return actions


@dataclass(frozen=True)
class MoveWithService(HoldingRule):
    """Baseline that never holds but sends buses to service like the holding rules.

    The gain of those rules over it is therefore due to holding only.
    """

    def hold(self, fleet: FleetState) -> NDArray[np.bool_]:
        return np.zeros(fleet.event.shape, np.bool_)

    def seconds(self, fleet: FleetState) -> Floats:
        return np.zeros(fleet.event.shape)


@dataclass(frozen=True)
class AlwaysMove(MoveWithService):
    """Baseline that never holds and never sends buses to service."""

    def act(self, env: BatchedEnv, observed: Observations) -> NDArray[Any]:
        if self.prepared.config.holds:
            return super().act(env, observed)
        return np.full(observed.alive.shape, MOVE, np.int64)


@dataclass(frozen=True)
class HeadwayHolding(HoldingRule):
    """Forward headway control: hold while the headway to the bus ahead is below a share of the target.

    A bus is also held if the bus ahead has not yet left that stop. Buses are held at stops and terminals,
    but leave a terminal at most one dispatch window after their scheduled departure.
    """

    share: float
    """Share of the target headway below which a bus is held."""

    def hold(self, fleet: FleetState) -> NDArray[np.bool_]:
        close = (fleet.headway < self.share * fleet.target) | (fleet.on_way & fleet.follows_closely)
        return np.asarray(close & ~(fleet.terminal & (fleet.event > self._latest(fleet))))

    def seconds(self, fleet: FleetState) -> Floats:
        wanted = self.share * fleet.target - fleet.forward
        return np.where(fleet.terminal, np.minimum(wanted, self._latest(fleet) - fleet.event), wanted)

    def _latest(self, fleet: FleetState) -> Floats:
        return fleet.departure + self.prepared.config.dispatch_window_s


@dataclass(frozen=True)
class EvenHeadway(HoldingRule):
    """Hold a bus that is nearer to the bus ahead than to the bus behind; leave terminals on schedule.

    It is held only while the bus ahead is also nearer than the target headway.
    """

    def hold(self, fleet: FleetState) -> NDArray[np.bool_]:
        uneven = fleet.on_way & (fleet.behind > fleet.ahead) & (fleet.ahead < 1.0)
        return np.asarray(uneven | fleet.before_schedule)

    def seconds(self, fleet: FleetState) -> Floats:
        # Holding for x s lengthens the spacing ahead and shortens the one behind, each by x.
        half, short = 0.5 * (fleet.backward - fleet.forward), fleet.target - fleet.forward
        return np.where(fleet.on_way, np.minimum(half, short), 0.0)


@dataclass(frozen=True)
class ScheduleHolding(HoldingRule):
    """Hold until the planned time, at stops and terminals."""

    def hold(self, fleet: FleetState) -> NDArray[np.bool_]:
        early = fleet.on_way & (fleet.event < fleet.planned)
        return np.asarray(early | fleet.before_schedule)

    def seconds(self, fleet: FleetState) -> Floats:
        return np.where(fleet.on_way, fleet.planned - fleet.ready, 0.0)
