"""Classical holding controllers, and baselines without holding.

All rules but `always_move` also send buses to the service centre in time, as a dispatcher would
(`FleetState.due_for_service`). The rules read the environment's arrays, including the bus's next arrival
time.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from headway.contracts import BatchedEnv, Observations
from headway_envs.bus.env import BusBatchedEnv
from headway_envs.bus.kernel.layout import (
    DRIVING,
    FIRST_KNOT_HOUR,
    KNOTS,
    MOVE,
    SERVICE_CENTER,
    STANDING,
    TERMINAL,
    WAIT,
)

if TYPE_CHECKING:
    from headway_envs.bus.prepared import Prepared

Floats = NDArray[np.float64]
FUEL_MARGIN = 1.25
"""Safety margin on fuel: the driving time that a bus's fuel lasts for is divided by this factor."""
NEAR_S = 60.0
"""Tolerance, s, for terminals near a service centre: a terminal is near if its detour exceeds the shortest
detour of its line by at most this time."""
MIN_WORN_SHARE = 0.5
"""Share of the planned driving time until the depot that a bus must spend below the warning level of uptime
to be sent to service."""


def _at(curves: Floats, rows: NDArray[np.int64], time: Floats) -> Floats:
    """Return the values of rows of (rows, K) knot curves at times in s, interpolated as in the kernel."""
    place = np.clip(time / 3600.0 - FIRST_KNOT_HOUR - 0.5, 0.0, KNOTS - 1)
    knot = np.minimum(place.astype(np.int64), KNOTS - 2)
    weight = place - knot
    return np.asarray((1.0 - weight) * curves[rows, knot] + weight * curves[rows, knot + 1])


class FleetState:
    """State of all buses of C copies as (C, N) arrays; times in s. Values are computed when first read,
    because `lookahead` asks its base rule many thousand times per day."""

    def __init__(self, env: BatchedEnv) -> None:
        """Raises TypeError for any environment but the bus environment."""
        if not isinstance(env, BusBatchedEnv):
            raise TypeError(f"the bus rules need a BusBatchedEnv, not {type(env).__name__}")
        self._env, self._net, self._world = env, env.network, env.world
        self._slots = env.world.slots
        self._phase = self._slots["phase"]
        self.event: Floats = env.world.event_time
        """Time of the next event: arrival for a driving bus, else the next decision."""
        self.now: Floats = env.world.days["now"][:, None]
        """(C, 1) current time."""
        self.terminal: NDArray[np.bool_] = self._phase == TERMINAL
        """Whether the bus waits at a terminal for its next trip."""
        self.on_way: NDArray[np.bool_] = (self._phase == DRIVING) | (self._phase == STANDING)
        """Whether the bus drives or stands at a stop."""
        self.departure: Floats = env.network.trip_departure[self._slots["trip"]]
        """Scheduled departure time of the trip."""
        self.ahead: Floats = self._slots["ahead"]
        """Spacing to the bus ahead over the target headway; NaN without a neighbour."""
        self.behind: Floats = self._slots["behind"]
        """Spacing to the bus behind over the target headway; NaN without a neighbour."""

    @property
    def _call(self) -> NDArray[np.int64]:
        """Call of the next event."""
        return np.asarray(self._slots["call"] + (self._phase == DRIVING))

    @cached_property
    def headway(self) -> Floats:
        """Headway at the next event, since the last departure from that call, s; infinite before the first
        departure."""
        since = np.take_along_axis(self._world.queues["last_departure"], self._call, axis=1)
        return np.where(since > 0, self.event - since, np.inf)

    @cached_property
    def target(self) -> Floats:
        """Target headway of the pattern at the next event, s."""
        return _at(self._net.target, self._slots["pattern"], np.maximum(self.event, 0.0).clip(max=1e6))

    @cached_property
    def planned(self) -> Floats:
        """Planned time at the call of the next event."""
        return self.departure + _at(self._net.nominal, self._call, self.departure)

    @cached_property
    def due_for_service(self) -> NDArray[np.bool_]:
        """Whether the bus should go to service at its current terminal.

        Inputs are the driving time until the bus's next stay at the depot and the terminals of its line
        nearest to a service centre. A bus at such a terminal is sent if its fuel, with a margin, lasts
        neither to the depot nor for a round trip (twice its line's longest trip), or if its uptime would fall
        below the warning level within a round trip and early enough before the depot (`MIN_WORN_SHARE`). At
        any other terminal a bus is sent only if its fuel lasts neither to the depot nor for one more trip.
        """
        net, slots, upkeep = self._net, self._slots, self._env.prepared.config.upkeep
        trip, line_way = net.line_trip[net.slot_line], net.line_detour[net.slot_line]
        to_drive = net.trip_work_left[slots["trip"]]
        fuel_range = slots["fuel"] * upkeep.seconds_per_fuel_unit / FUEL_MARGIN
        wear_range = (slots["uptime"] - upkeep.warning) * upkeep.uptime_hours * 3600.0
        near = net.detour[slots["call"]] <= line_way + NEAR_S
        soon = fuel_range < np.minimum(np.where(near, 2.0, 1.0) * trip, to_drive)
        worn = near & (wear_range < np.minimum(2.0 * trip, (1.0 - MIN_WORN_SHARE) * to_drive))
        return np.asarray(soon | worn)


def _actions(fleet: FleetState, hold: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Return WAIT where `hold`, else MOVE; SERVICE_CENTER takes precedence at terminals."""
    actions = np.where(hold, WAIT, MOVE).astype(np.int64)
    if fleet.terminal.any():
        actions[fleet.terminal & fleet.due_for_service] = SERVICE_CENTER
    return actions


def _too_close(fleet: FleetState, share: float) -> NDArray[np.bool_]:
    """Return which buses have a headway below `share` of the target at their next event, (C, N).

    A bus is also too close if the bus ahead has not yet left that stop.
    """
    near = fleet.ahead * fleet.target < fleet.event - fleet.now
    return (fleet.headway < share * fleet.target) | (fleet.on_way & near)


def _before_schedule(fleet: FleetState) -> NDArray[np.bool_]:
    """Return which buses are at a terminal before their scheduled departure."""
    return fleet.terminal & (fleet.event < fleet.departure)


@dataclass(frozen=True)
class MoveWithService:
    """Baseline that never holds but sends buses to service like the holding rules.

    The gain of those rules over it is therefore due to holding only.
    """

    prepared: "Prepared"

    def act(self, env: BatchedEnv, observed: Observations) -> NDArray[np.int64]:
        return _actions(FleetState(env), np.zeros(observed.alive.shape, np.bool_))


@dataclass(frozen=True)
class HeadwayHolding:
    """Forward headway control: hold while the headway to the bus ahead is below a share of the target.

    Buses are held at stops and terminals, but leave a terminal at most one dispatch window after their
    scheduled departure.
    """

    prepared: "Prepared"
    share: float
    """Share of the target headway below which a bus is held."""

    def act(self, env: BatchedEnv, observed: Observations) -> NDArray[np.int64]:
        fleet = FleetState(env)
        overdue = fleet.terminal & (fleet.event > fleet.departure + self.prepared.config.dispatch_window_s)
        return _actions(fleet, _too_close(fleet, self.share) & ~overdue)


@dataclass(frozen=True)
class EvenHeadway:
    """Hold a bus that is nearer to the bus ahead than to the bus behind; leave terminals on schedule.

    It is held only while the bus ahead is also nearer than the target headway.
    """

    prepared: "Prepared"

    def act(self, env: BatchedEnv, observed: Observations) -> NDArray[np.int64]:
        fleet = FleetState(env)
        uneven = fleet.on_way & (fleet.behind > fleet.ahead) & (fleet.ahead < 1.0)
        return _actions(fleet, uneven | _before_schedule(fleet))


@dataclass(frozen=True)
class ScheduleHolding:
    """Hold until the planned time, at stops and terminals."""

    prepared: "Prepared"

    def act(self, env: BatchedEnv, observed: Observations) -> NDArray[np.int64]:
        fleet = FleetState(env)
        early = fleet.on_way & (fleet.event < fleet.planned)
        return _actions(fleet, early | _before_schedule(fleet))
