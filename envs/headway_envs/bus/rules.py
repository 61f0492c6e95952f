"""Classical controllers of holding. All but `always_move` also send buses to the service centre in time, as a
dispatcher would (see `_due_for_service`). They read the environment's arrays, including the bus's next
arrival time."""

from dataclasses import dataclass
from itertools import pairwise
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
"""Safety margin on fuel: a bus is refuelled while it can still drive this many times what it needs."""
NEAR_S = 60.0
"""A terminal counts as near a service centre if its detour is at most this much longer than the line's
shortest, s."""
WORTH_REPAIR = 0.5
"""Minimum share of its remaining planned driving time that a worn bus would drive below the warning level; it
is not serviced for less."""


@dataclass(frozen=True)
class FleetState:
    """Situation of all buses as (C, N) arrays; times in s."""

    event: Floats
    """Time of the next event: the arrival of a driving bus, else its next decision."""
    now: Floats
    """(C, 1) current time."""
    terminal: NDArray[np.bool_]
    on_way: NDArray[np.bool_]
    headway: Floats
    """Headway at the next event, since the last departure from that call, s; infinite before the first
    departure."""
    target: Floats
    departure: Floats
    """Scheduled departure time of the trip."""
    planned: Floats
    """Planned time at the call of the next event."""
    ahead: Floats
    """Spacing to the bus ahead divided by the target headway; NaN without a neighbour."""
    behind: Floats
    due_for_service: NDArray[np.bool_]


def _at(curves: Floats, rows: NDArray[np.int64], time: Floats) -> Floats:
    """Return rows of (rows, K) knot curves at times in s, interpolated as the kernel does."""
    place = np.clip(time / 3600.0 - FIRST_KNOT_HOUR - 0.5, 0.0, KNOTS - 1)
    knot = np.minimum(place.astype(np.int64), KNOTS - 2)
    weight = place - knot
    return np.asarray((1.0 - weight) * curves[rows, knot] + weight * curves[rows, knot + 1])


def look(env: BatchedEnv) -> FleetState:
    """Return the scene of a bus environment. Raises TypeError for any other environment."""
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

    A dispatcher knows how long a bus still drives before it is back at the depot, and which terminals of its
    line are nearest to a service centre. A bus at such a terminal is sent if its fuel, with a margin, lasts
    neither to the depot nor until it comes by again (twice its line's longest trip), or if its uptime would
    fall below the warning level before both and early enough to be worth it (`WORTH_REPAIR`). At any other
    terminal a bus is sent only if its fuel does not last for one more trip.
    """
    net, slots, upkeep = env.network, env.world.slots, env.prepared.config.upkeep
    ends = net.pattern_calls[1:] - 1
    longest, way = np.zeros(len(net.line_slots) - 1), np.zeros(len(net.line_slots) - 1)
    for line, (begin, end) in enumerate(pairwise(net.line_patterns)):
        longest[line] = net.nominal[ends[begin:end]].max()
        way[line] = net.detour[net.pattern_calls[begin:end]].min()
    trip, line_way = longest[net.slot_line], way[net.slot_line]
    to_drive = net.trip_work_left[slots["trip"]]
    fuel_range = slots["fuel"] * upkeep.seconds_per_fuel_unit / FUEL_MARGIN
    wear_range = (slots["uptime"] - upkeep.warning) * upkeep.uptime_hours * 3600.0
    near = net.detour[slots["call"]] <= line_way + NEAR_S
    soon = fuel_range < np.minimum(np.where(near, 2.0, 1.0) * trip, to_drive)
    worn = near & (wear_range < np.minimum(2.0 * trip, (1.0 - WORTH_REPAIR) * to_drive))
    return np.asarray(soon | worn)


def _actions(scene: FleetState, hold: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Return WAIT where `hold`, else MOVE; SERVICE_CENTER takes precedence at terminals."""
    actions = np.where(hold, WAIT, MOVE).astype(np.int64)
    actions[scene.terminal & scene.due_for_service] = SERVICE_CENTER
    return actions


def _spaced(scene: FleetState, share: float) -> NDArray[np.bool_]:
    """Return where the headway at the next event is below `share` of the target, or where the bus ahead has
    not yet left that stop."""
    near = scene.ahead * scene.target < scene.event - scene.now
    return (scene.headway < share * scene.target) | (scene.on_way & near)


def _early(scene: FleetState) -> NDArray[np.bool_]:
    """Return which buses are at a terminal before their scheduled departure."""
    return scene.terminal & (scene.event < scene.departure)


@dataclass(frozen=True)
class AlwaysMove:
    """Baseline that always moves: it leaves every stop and terminal at once and never goes to the service
    centre."""

    prepared: "Prepared"

    def act(self, env: BatchedEnv, observed: Observations) -> NDArray[np.int64]:
        return np.full(observed.alive.shape, MOVE, np.int64)


@dataclass(frozen=True)
class MoveWithService:
    """Baseline that never holds but is serviced in time like the holding rules, so that their gain over it is
    due to holding alone."""

    prepared: "Prepared"

    def act(self, env: BatchedEnv, observed: Observations) -> NDArray[np.int64]:
        return _actions(look(env), np.zeros(observed.alive.shape, np.bool_))


@dataclass(frozen=True)
class HeadwayHolding:
    """Forward headway control: hold, at stops and terminals, while the headway to the bus ahead is below a
    share of the target. A bus leaves a terminal at most one dispatch window after schedule."""

    prepared: "Prepared"
    share: float

    def act(self, env: BatchedEnv, observed: Observations) -> NDArray[np.int64]:
        scene = look(env)
        overdue = scene.terminal & (scene.event > scene.departure + self.prepared.config.dispatch_window_s)
        return _actions(scene, _spaced(scene, self.share) & ~overdue)


@dataclass(frozen=True)
class EvenHeadway:
    """Hold while the bus behind is farther away than the bus ahead and that one is nearer than the target
    headway; leave terminals by schedule."""

    prepared: "Prepared"

    def act(self, env: BatchedEnv, observed: Observations) -> NDArray[np.int64]:
        scene = look(env)
        uneven = scene.on_way & (scene.behind > scene.ahead) & (scene.ahead < 1.0)
        return _actions(scene, uneven | _early(scene))


@dataclass(frozen=True)
class ScheduleHolding:
    """Hold until the planned time, at stops and terminals."""

    prepared: "Prepared"

    def act(self, env: BatchedEnv, observed: Observations) -> NDArray[np.int64]:
        scene = look(env)
        early = scene.on_way & (scene.event < scene.planned)
        return _actions(scene, early | _early(scene))
