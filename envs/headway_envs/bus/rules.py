"""Classical holding controllers, and baselines without holding.

All rules but `always_move` also send buses to the service centre in time, as a dispatcher would
(`_due_for_service`). The rules read the environment's arrays, including the bus's next arrival time.
"""

from dataclasses import dataclass
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
"""Maximum time by which a terminal's detour may exceed its line's shortest detour to count as near a service
centre, s."""
MIN_WORN_SHARE = 0.5
"""Share of the planned driving time until the depot that a bus must spend below the warning level of uptime
to be sent to service."""


@dataclass(frozen=True)
class FleetState:
    """State of all buses of C copies as (C, N) arrays; times in s."""

    event: Floats
    """Time of the next event: arrival for a driving bus, else the next decision."""
    now: Floats
    """(C, 1) current time."""
    terminal: NDArray[np.bool_]
    """Whether the bus waits at a terminal for its next trip."""
    on_way: NDArray[np.bool_]
    """Whether the bus drives or stands at a stop."""
    headway: Floats
    """Headway at the next event, since the last departure from that call, s; infinite before the first
    departure."""
    target: Floats
    """Target headway of the pattern at the next event, s."""
    departure: Floats
    """Scheduled departure time of the trip."""
    planned: Floats
    """Planned time at the call of the next event."""
    ahead: Floats
    """Spacing to the bus ahead over the target headway; NaN without a neighbour."""
    behind: Floats
    """Spacing to the bus behind over the target headway; NaN without a neighbour."""
    due_for_service: NDArray[np.bool_]
    """Whether the bus should go to service at its current terminal."""


def _at(curves: Floats, rows: NDArray[np.int64], time: Floats) -> Floats:
    """Return the values of rows of (rows, K) knot curves at times in s, interpolated as in the kernel."""
    place = np.clip(time / 3600.0 - FIRST_KNOT_HOUR - 0.5, 0.0, KNOTS - 1)
    knot = np.minimum(place.astype(np.int64), KNOTS - 2)
    weight = place - knot
    return np.asarray((1.0 - weight) * curves[rows, knot] + weight * curves[rows, knot + 1])


def fleet_state(env: BatchedEnv) -> FleetState:
    """Return the fleet state of a bus environment. Raises TypeError for any other environment."""
    if not isinstance(env, BusBatchedEnv):
        raise TypeError(f"the bus rules need a BusBatchedEnv, not {type(env).__name__}")
    net, world = env.network, env.world
    slots = world.slots
    phase, pattern = slots["phase"], slots["pattern"]
    call = slots["call"] + (phase == DRIVING)
    since = np.take_along_axis(world.queues["last_departure"], call, axis=1)
    departure = net.trip_departure[slots["trip"]]
    return FleetState(
        event=world.event_time,
        now=world.days["now"][:, None],
        terminal=phase == TERMINAL,
        on_way=(phase == DRIVING) | (phase == STANDING),
        headway=np.where(since > 0, world.event_time - since, np.inf),
        target=_at(net.target, pattern, np.maximum(world.event_time, 0.0).clip(max=1e6)),
        departure=departure,
        planned=departure + _at(net.nominal, call, departure),
        ahead=slots["ahead"],
        behind=slots["behind"],
        due_for_service=_due_for_service(env),
    )


def _due_for_service(env: BusBatchedEnv) -> NDArray[np.bool_]:
    """Return which buses should go to service at their current terminal, (C, N).

    Inputs are the driving time until the bus's next stay at the depot and the terminals of its line nearest
    to a service centre. A bus at such a terminal is sent if its fuel, with a margin, lasts neither to the
    depot nor for a round trip (twice its line's longest trip), or if its uptime would fall below the warning
    level within a round trip and early enough before the depot (`MIN_WORN_SHARE`). At any other terminal a
    bus is sent only if its fuel lasts neither to the depot nor for one more trip.
    """
    net, slots, upkeep = env.network, env.world.slots, env.prepared.config.upkeep
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
        return _actions(fleet_state(env), np.zeros(observed.alive.shape, np.bool_))


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
        fleet = fleet_state(env)
        overdue = fleet.terminal & (fleet.event > fleet.departure + self.prepared.config.dispatch_window_s)
        return _actions(fleet, _too_close(fleet, self.share) & ~overdue)


@dataclass(frozen=True)
class EvenHeadway:
    """Hold a bus that is nearer to the bus ahead than to the bus behind; leave terminals on schedule.

    It is held only while the bus ahead is also nearer than the target headway.
    """

    prepared: "Prepared"

    def act(self, env: BatchedEnv, observed: Observations) -> NDArray[np.int64]:
        fleet = fleet_state(env)
        uneven = fleet.on_way & (fleet.behind > fleet.ahead) & (fleet.ahead < 1.0)
        return _actions(fleet, uneven | _before_schedule(fleet))


@dataclass(frozen=True)
class ScheduleHolding:
    """Hold until the planned time, at stops and terminals."""

    prepared: "Prepared"

    def act(self, env: BatchedEnv, observed: Observations) -> NDArray[np.int64]:
        fleet = fleet_state(env)
        early = fleet.on_way & (fleet.event < fleet.planned)
        return _actions(fleet, early | _before_schedule(fleet))
