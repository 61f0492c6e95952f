"""Where the buses of a line are relative to each other."""

import numpy as np

from headway_envs.bus.kernel.compiled import compiled
from headway_envs.bus.kernel.curves import at
from headway_envs.bus.kernel.layout import (
    AWAY,
    BROKEN,
    DEPOT,
    DRIVING,
    STANDING,
    Network,
    Record,
    World,
)

LEFT_OUT, COUNTED, MISSING_FROM_LINE = 0, 1, 2
"""How a slot enters the regularity c."""


@compiled
def _set_place(net: Network, k: Record, world: World, c: int, n: int, now: float) -> None:
    """Nominal seconds along the pattern, and whether the slot is scheduled to be in service."""
    slot = world.slots[c, n]
    slot.place = 0.0
    slot.counted = LEFT_OUT
    if slot.phase == DEPOT:
        return
    if slot.phase == DRIVING:
        begin = at(net.nominal, slot.call, now)
        end = at(net.nominal, slot.call + 1, now)
        way = max(world.event_time[c, n] - slot.left, 1e-6)
        slot.place = begin + min((now - slot.left) / way, 1.0) * (end - begin)
    elif slot.call > net.pattern_calls[slot.pattern]:
        slot.place = at(net.nominal, slot.call, now)
    due = now > net.trip_departure[slot.trip] + k.dispatch_window_s
    if world.departed[c, slot.trip] or due:
        slot.counted = MISSING_FROM_LINE if slot.phase == AWAY or slot.phase == BROKEN else COUNTED


@compiled
def _next_departure(net: Network, world: World, c: int, pattern: int, own_trip: int) -> float:
    """Scheduled departure of the pattern's next trip that has not left, the slot's own left out; infinite
    if there is none."""
    trip = world.patterns[c, pattern].next_trip
    last = net.pattern_trips[pattern + 1]
    while trip < last and (world.departed[c, trip] or trip == own_trip):
        trip += 1
    return net.trip_departure[trip] if trip < last else np.inf


@compiled
def _set_spacing(net: Network, world: World, c: int, n: int, line: int, now: float) -> None:
    """Time spacing to the bus ahead and behind over the target headway.

    Ahead of the pattern's leader is the bus that finished last, as if it had driven on; behind the last bus
    is the next scheduled departure."""
    slot = world.slots[c, n]
    on_route = slot.phase == DRIVING or slot.phase == STANDING
    ahead, behind = np.inf, np.inf
    slot.leader = -1
    for m in range(net.line_slots[line], net.line_slots[line + 1]):
        other = world.slots[c, m]
        if m == n or other.pattern != slot.pattern:
            continue
        if other.phase != DRIVING and other.phase != STANDING:
            continue
        gap = other.place - slot.place
        if gap > 0.0 or (gap == 0.0 and (m < n or not on_route)):
            if gap < ahead:
                ahead, slot.leader = gap, m
        else:
            behind = min(behind, -gap)
    finish = world.patterns[c, slot.pattern].last_finish
    if ahead == np.inf and finish >= 0.0:
        end = at(net.nominal, net.pattern_calls[slot.pattern + 1] - 1, now)
        ahead = end - slot.place + now - finish
    if behind == np.inf:
        following = _next_departure(net, world, c, slot.pattern, slot.trip)
        behind = slot.place + max(following - now, 0.0)
    target = at(net.target, slot.pattern, now - slot.place)
    slot.ahead = ahead / target if ahead < np.inf else np.nan
    slot.behind = behind / target if behind < np.inf else np.nan


@compiled
def space_line(net: Network, k: Record, world: World, c: int, line: int) -> None:
    """Update place, spacings and regularity of the line's slots."""
    now = world.days[c].now
    first, last = net.line_slots[line], net.line_slots[line + 1]
    for n in range(first, last):
        _set_place(net, k, world, c, n, now)
    for n in range(first, last):
        slot = world.slots[c, n]
        slot.regularity = 0.0
        slot.leader = -1
        slot.ahead = np.nan
        slot.behind = np.nan
        if slot.phase == DEPOT:
            continue
        _set_spacing(net, world, c, n, line, now)
        if slot.counted == MISSING_FROM_LINE:
            slot.regularity = -1.0
        elif slot.counted == COUNTED:
            if np.isnan(slot.ahead):
                slot.counted = LEFT_OUT
            else:
                slot.regularity = max(1.0 - abs(slot.ahead - 1.0), -1.0)
