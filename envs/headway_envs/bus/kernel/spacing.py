"""Positions and spacings of the buses of a line."""

import numpy as np

from headway_envs.bus.kernel.compiled import compiled
from headway_envs.bus.kernel.curves import interpolate
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
"""Role of a slot in the regularity component c of the reward. LEFT_OUT: not counted; COUNTED: scheduled to be
in service; MISSING_FROM_LINE: scheduled, but broken down or at the service centre."""


@compiled
def _set_place(net: Network, k: Record, world: World, c: int, n: int, now: float) -> None:
    """Set the slot's position along the pattern, nominal s, and whether it is scheduled to be in service."""
    slot = world.slots[c, n]
    slot.place = 0.0
    slot.counted = LEFT_OUT
    if slot.phase == DEPOT:
        return
    if slot.phase == DRIVING:
        begin = interpolate(net.nominal, slot.call, now)
        end = interpolate(net.nominal, slot.call + 1, now)
        # Between calls the position follows from the share of the driving time that has passed.
        way = max(world.event_time[c, n] - slot.left, 1e-6)
        slot.place = begin + min((now - slot.left) / way, 1.0) * (end - begin)
    elif slot.call > net.pattern_calls[slot.pattern]:
        slot.place = interpolate(net.nominal, slot.call, now)
    # A bus held at its terminal beyond the dispatch window counts as in service.
    due = now > net.trip_departure[slot.trip] + k.dispatch_window_s
    if world.departed[c, slot.trip] or due:
        slot.counted = MISSING_FROM_LINE if slot.phase == AWAY or slot.phase == BROKEN else COUNTED


@compiled
def _ready_after_trip(net: Network, k: Record, world: World, c: int, n: int, now: float) -> float:
    """Return when a bus that has left on a trip is expected to be ready for its next one, s."""
    slot = world.slots[c, n]
    end = interpolate(net.nominal, net.pattern_calls[slot.pattern + 1] - 1, now)
    ready: float = now + max(end - slot.place, 0.0) + k.minimum_layover_s
    ready += net.trip_deadhead[net.slot_trips[slot.block + 1]]
    if slot.phase == AWAY or slot.phase == BROKEN:
        ready += world.event_time[c, n] - now
    if slot.phase == BROKEN:
        ready += k.service_s + 2.0 * net.detour[slot.call]
    return ready


@compiled
def _next_departure(
    net: Network, k: Record, world: World, c: int, line: int, pattern: int, own_trip: int, now: float
) -> float:
    """Return when the next bus is expected to leave on a trip of the pattern other than `own_trip`, s;
    infinite if there is none.

    A bus leaves on schedule or, if that is later, once it is ready after the trips before.
    """
    soonest = np.inf
    for n in range(net.line_slots[line], net.line_slots[line + 1]):
        block, last = world.slots[c, n].block, net.slot_first[n + 1]
        if block == last:
            continue
        ready = max(world.event_time[c, n], now)
        if world.departed[c, net.slot_trips[block]]:
            block += 1
            if block == last:
                continue
            ready = _ready_after_trip(net, k, world, c, n, now)
        while ready < soonest:
            trip = net.slot_trips[block]
            leaves = max(net.trip_departure[trip], ready)
            if net.trip_pattern[trip] == pattern and trip != own_trip:
                soonest = min(soonest, leaves)
                break
            block += 1
            if block == last:
                break
            end = net.pattern_calls[net.trip_pattern[trip] + 1] - 1
            ready = leaves + interpolate(net.nominal, end, leaves)
            ready += k.minimum_layover_s + net.trip_deadhead[net.slot_trips[block]]
    return soonest


@compiled
def _set_spacing(net: Network, k: Record, world: World, c: int, n: int, line: int, now: float) -> None:
    """Set the slot's time spacings to the bus ahead and to the bus behind, over the target headway.

    For the pattern's first bus, the bus ahead is the one that finished last, as if it had driven on; for the
    last bus, the bus behind is the next that is expected to leave on the pattern.
    """
    slot = world.slots[c, n]
    on_route = slot.phase == DRIVING or slot.phase == STANDING
    ahead, behind = np.inf, np.inf
    for m in range(net.line_slots[line], net.line_slots[line + 1]):
        other = world.slots[c, m]
        if m == n or other.pattern != slot.pattern:
            continue
        if other.phase != DRIVING and other.phase != STANDING:
            continue
        gap = other.place - slot.place
        # Of two buses at the same place the one with the lower slot counts as ahead.
        if gap > 0.0 or (gap == 0.0 and (m < n or not on_route)):
            if gap < ahead:
                ahead, slot.leader = gap, m
        else:
            behind = min(behind, -gap)
    finish = world.last_finish[c, slot.pattern]
    if ahead == np.inf and finish >= 0.0:
        end = interpolate(net.nominal, net.pattern_calls[slot.pattern + 1] - 1, now)
        ahead = end - slot.place + now - finish
    if behind == np.inf:
        following = _next_departure(net, k, world, c, line, slot.pattern, slot.trip, now)
        behind = slot.place + following - now
    # The target at the time when a bus at this position left the first call.
    target = interpolate(net.target, slot.pattern, now - slot.place)
    slot.ahead = ahead / target if ahead < np.inf else np.nan
    slot.behind = behind / target if behind < np.inf else np.nan


@compiled
def update_line_spacings(net: Network, k: Record, world: World, c: int, line: int) -> None:
    """Update position, spacings and regularity of all slots of a line."""
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
        _set_spacing(net, k, world, c, n, line, now)
        if slot.counted == MISSING_FROM_LINE:
            slot.regularity = -1.0
        elif slot.counted == COUNTED:
            if np.isnan(slot.ahead):
                slot.counted = LEFT_OUT
            else:
                slot.regularity = max(1.0 - abs(slot.ahead - 1.0), -1.0)
