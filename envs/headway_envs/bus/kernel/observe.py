"""Observations of the agents, action masks, and the global state of central critics."""

import math

import numpy as np
from numpy.typing import NDArray

from headway_envs.bus.kernel.compiled import compiled
from headway_envs.bus.kernel.curves import bin_of, interpolate
from headway_envs.bus.kernel.layout import (
    AWAY,
    BROKEN,
    DAY_STATE,
    DEPOT,
    DISPATCHED,
    DRIVING,
    LIMIT_NEXT,
    LINE_STATE,
    MOVE,
    SERVICE_CENTER,
    SKIP_NEXT,
    STANDING,
    TERMINAL,
    WAIT,
    Network,
    Record,
    World,
)
from headway_envs.bus.kernel.motion import may_restrict
from headway_envs.bus.kernel.upkeep import is_serviceable


@compiled
def _clip(value: float, low: float, high: float) -> float:
    return min(max(value, low), high)


@compiled
def _spacing_or_one(spacing: float) -> float:
    """Return a spacing, at most 3, or 1 (the target) without a neighbour."""
    return 1.0 if np.isnan(spacing) else min(spacing, 3.0)


@compiled
def _observe_basic(
    net: Network, k: Record, world: World, c: int, n: int, out: NDArray[np.float32], published: bool
) -> None:
    """Fill the paper's four features, or the eight of the released code in its order, scaled to [0, 1]."""
    slot, now = world.slots[c, n], world.days[c].now
    first, last = net.pattern_calls[slot.pattern], net.pattern_calls[slot.pattern + 1] - 1
    following = min(slot.call + 1, last)
    link = min(slot.call, last - 1)
    bins = net.boarding_rate.shape[1]
    demand = net.boarding_rate[following, bin_of(now, k.start_s, bins)]
    travel_time = min(interpolate(net.running, link, now) / 300.0, 1.0)
    future_demand = min(demand * interpolate(net.target, slot.pattern, now) / 20.0, 1.0)
    occupancy = slot.load / k.capacity
    if not published:
        out[0], out[1], out[2], out[3] = travel_time, future_demand, occupancy, slot.uptime
        return
    out[0] = (now - k.start_s) / (k.end_s - k.start_s)
    out[1], out[2], out[3], out[4] = occupancy, travel_time, future_demand, slot.uptime
    worn = slot.phase == BROKEN or slot.uptime < k.warning or slot.fuel < k.warning * k.fuel_capacity
    out[5] = 0.0 if worn else 1.0
    out[6] = (slot.call - first) / (last - first)
    out[7] = (following - first) / (last - first)


@compiled
def _observe_control(net: Network, k: Record, world: World, c: int, n: int, out: NDArray[np.float32]) -> None:
    """Fill the eight features of `published` and, from index 8 on, those that holding and service need."""
    slot, now = world.slots[c, n], world.days[c].now
    _observe_basic(net, k, world, c, n, out, True)
    last = net.pattern_calls[slot.pattern + 1] - 1
    place = slot.call + 1 if slot.phase == DRIVING else slot.call
    target = interpolate(net.target, slot.pattern, now)
    event = world.event_time[c, n]
    since = world.queues[c, place].last_departure
    ahead, behind = _spacing_or_one(slot.ahead), _spacing_or_one(slot.behind)
    out[8] = slot.fuel / k.fuel_capacity
    out[9] = ahead - 1.0
    out[10] = behind - 1.0
    out[11] = 0.5 * (ahead - behind)
    out[12] = _clip(slot.headway_ratio - 1.0, -1.0, 2.0)
    departure = net.trip_departure[slot.trip]
    out[13] = _clip((now - departure - slot.place) / 1800.0, -2.0, 2.0)
    out[14] = slot.place / max(interpolate(net.nominal, last, now), 1.0)
    rate = net.boarding_rate[place, bin_of(now, k.start_s, net.boarding_rate.shape[1])]
    out[15] = min(rate * (event - since) / 20.0, 3.0) if since > 0.0 else 0.0
    out[16] = slot.phase == STANDING
    out[17] = slot.phase == TERMINAL or slot.phase == DISPATCHED
    out[18] = slot.phase == AWAY or slot.phase == BROKEN
    angle = 2.0 * math.pi * now / 86400.0
    out[19] = math.sin(angle)
    out[20] = math.cos(angle)
    out[21] = min(slot.held / 300.0, 3.0)
    out[22] = min((event - now) / k.tick_s, 5.0) / 5.0
    out[23] = _clip((event - since) / target - 1.0, -1.0, 2.0) if since > 0.0 and place < last else 0.0
    out[24] = _clip((departure - now) / 600.0, -2.0, 2.0) if slot.phase == TERMINAL else 0.0
    out[25] = slot.pattern - net.line_patterns[net.slot_line[n]]
    out[26] = max(net.trip_work_left[slot.trip] - slot.place, 0.0) / 43200.0
    line = world.lines[c, net.slot_line[n]]
    out[27], out[28] = line.service, line.regularity


@compiled
def _observe_network(net: Network, k: Record, world: World, c: int, n: int, out: NDArray[np.float32]) -> None:
    """Fill the features of `control` and, from index 29 on, those that tell lines apart."""
    _observe_control(net, k, world, c, n, out)
    slot, line = world.slots[c, n], net.slot_line[n]
    out[29] = min(net.line_trip[line] / 3600.0, 5.0)
    out[30] = min(interpolate(net.target, slot.pattern, world.days[c].now) / 1800.0, 5.0)
    out[31] = min(net.detour[slot.call] / 1800.0, 5.0)
    out[32] = min((net.detour[slot.call] - net.line_detour[line]) / 300.0, 5.0)


@compiled
def _mask_restrictions(
    net: Network, k: Record, world: World, c: int, n: int, alive: bool, mask: NDArray[np.bool_]
) -> None:
    """Mask skipping and boarding limits where the bus may not order them at its next decision."""
    slot = world.slots[c, n]
    # A bus that has been held at its stop, or skips it, decides at a later one.
    decided = slot.phase == STANDING and (slot.held > 0.0 or slot.order == SKIP_NEXT)
    leaves = slot.phase == DRIVING or slot.phase == DISPATCHED or decided
    place = slot.call + leaves + (slot.next_order == SKIP_NEXT)
    place += (net.pattern_calls[slot.pattern] - place) % k.control_every
    mask[:] = True
    if k.skip_action >= 0 and alive:
        mask[k.skip_action] = may_restrict(net, world, c, slot.pattern, place, SKIP_NEXT)
    if k.limit_action >= 0 and alive:
        mask[k.limit_action] = may_restrict(net, world, c, slot.pattern, place, LIMIT_NEXT)


@compiled
def observe(
    net: Network,
    k: Record,
    world: World,
    c: int,
    observations: NDArray[np.float32],
    alive: NDArray[np.bool_],
    masks: NDArray[np.bool_],
) -> None:
    """Fill observations (N, D), alive mask (N,) and action masks (N, A) of one copy; actions that are only
    holding times have no masks.

    A slot is alive while it is out of the depot, and already in the interval of its first decision. Rows of
    dead slots are zeros, with all actions allowed.
    """
    until = world.days[c].now + k.tick_s
    for n in range(observations.shape[0]):
        phase = world.slots[c, n].phase
        alive[n] = phase != DEPOT or world.event_time[c, n] < until
        if not k.holding:
            masks[n, WAIT] = True
            masks[n, MOVE] = True
            # A bus that leaves the depot has been renewed: only a centre that accepts any bus would take it.
            unavailable = phase in (AWAY, BROKEN) or (phase == DEPOT and k.service_below < 1.0)
            serviceable = not unavailable and is_serviceable(k, world, c, n)
            masks[n, SERVICE_CENTER] = serviceable or not alive[n]
        elif k.skip_action >= 0 or k.limit_action >= 0:
            _mask_restrictions(net, k, world, c, n, alive[n], masks[n])
        if not alive[n]:
            observations[n, :] = 0.0
        elif k.observation == 3:
            _observe_network(net, k, world, c, n, observations[n])
        elif k.observation == 2:
            _observe_control(net, k, world, c, n, observations[n])
        else:
            _observe_basic(net, k, world, c, n, observations[n], k.observation == 1)


@compiled
def _observe_line(net: Network, k: Record, world: World, c: int, line: int, out: NDArray[np.float32]) -> None:
    """Fill the state features of a line: mean, spread and extremes of the spacings; service; load; shares of
    slots alive and on the route; fuel; uptime."""
    record = world.lines[c, line]
    total, squares, low, high, count = 0.0, 0.0, 3.0, 0.0, 0
    load, fuel, uptime = 0.0, 0.0, 0.0
    first, last = net.line_slots[line], net.line_slots[line + 1]
    for n in range(first, last):
        slot = world.slots[c, n]
        load += slot.load
        fuel += slot.fuel
        uptime += slot.uptime
        if slot.counted == 1 and not np.isnan(slot.ahead):
            ahead = min(slot.ahead, 3.0)
            total += ahead
            squares += ahead * ahead
            low, high = min(low, ahead), max(high, ahead)
            count += 1
    mean = total / count if count > 0 else 1.0
    out[0] = mean - 1.0
    out[1] = math.sqrt(max(squares / count - mean * mean, 0.0)) if count > 0 else 0.0
    out[2] = low - 1.0 if count > 0 else 0.0
    out[3] = high - 1.0 if count > 0 else 0.0
    out[4] = record.service
    out[5] = load / max(record.on_route, 1.0) / k.capacity
    out[6] = record.alive / (last - first)
    out[7] = record.on_route / (last - first)
    out[8] = fuel / (last - first) / k.fuel_capacity
    out[9] = uptime / (last - first)


@compiled
def observe_state(
    net: Network,
    k: Record,
    world: World,
    c: int,
    observations: NDArray[np.float32],
    state: NDArray[np.float32],
) -> None:
    """Fill the state (S,): features of the day, of each line and, with `full_state`, all agents'
    observations."""
    day = world.days[c]
    angle = 2.0 * math.pi * day.now / 86400.0
    state[0] = (day.now - k.start_s) / (k.end_s - k.start_s)
    state[1] = math.sin(angle)
    state[2] = math.cos(angle)
    place = DAY_STATE
    for line in range(net.line_slots.shape[0] - 1):
        _observe_line(net, k, world, c, line, state[place : place + LINE_STATE])
        place += LINE_STATE
    if k.full_state:
        for n in range(observations.shape[0]):
            for feature in range(observations.shape[1]):
                state[place] = observations[n, feature]
                place += 1
