"""Events of a bus, in continuous time: arrival, boarding, departure, breakdown and service."""

import math

import numpy as np
from numpy.typing import NDArray

from headway_envs.bus.kernel.compiled import compiled, compiled_apart
from headway_envs.bus.kernel.curves import bin_of, interpolate, period_of
from headway_envs.bus.kernel.draws import (
    ALIGHTING,
    BREAKDOWN,
    DISPATCH,
    INCIDENT,
    INCIDENT_SIZE,
    LINK,
    TRIP,
    binomial,
    exponential,
    normal,
    unit_lognormal,
)
from headway_envs.bus.kernel.layout import (
    AWAY,
    BIN_S,
    BROKEN,
    DEPOT,
    DISPATCHED,
    DRIVING,
    LIMIT_NEXT,
    MOVE,
    SERVICE_CENTER,
    SKIP_NEXT,
    STANDING,
    TERMINAL,
    Network,
    Record,
    Trace,
    World,
)
from headway_envs.bus.kernel.passengers import board, change_load, unload_passengers
from headway_envs.bus.kernel.upkeep import is_due_for_service, is_serviceable
from headway_envs.keyed_random import uniform


@compiled
def congestion_factor(k: Record, world: World, c: int, time: float) -> float:
    """Return copy c's congestion factor on travel times at `time` (s), interpolated between bins."""
    bins = world.congestion.shape[1] - 1
    bin_ = bin_of(time, k.start_s, bins)
    weight = min(max((time - k.start_s) / BIN_S - bin_, 0.0), 1.0)
    return float((1.0 - weight) * world.congestion[c, bin_] + weight * world.congestion[c, bin_ + 1])


@compiled
def link_time(net: Network, k: Record, world: World, c: int, n: int, time: float) -> float:
    """Return the travel time to the next call for a departure at `time`, s: mean x factors of trip, network,
    link and incident."""
    slot, day = world.slots[c, n], world.days[c]
    noise = unit_lognormal(normal(day.key, LINK, slot.trip, slot.call), net.noise_sd[slot.call])
    factor = slot.trip_factor * congestion_factor(k, world, c, time) * noise
    if uniform(day.key, INCIDENT, slot.trip, slot.call) < k.incident_probability:
        spread = 2.0 * (k.incident_factor - 2.0)
        factor *= 2.0 + spread * uniform(day.key, INCIDENT_SIZE, slot.trip, slot.call)
    if k.slow_s <= time < k.slow_s + 3600.0:
        factor *= net.slowness[slot.call]
    # Incidents must not change the mean, which is that of the table.
    factor /= 1.0 + k.incident_probability * (k.incident_factor - 1.0)
    return float(interpolate(net.running, slot.call, time) * factor)


@compiled
def charge_upkeep(k: Record, world: World, c: int, n: int, time: float, fuel_share: float) -> None:
    """Charge fuel, wear and breakdown hazard for the time since they were last charged. `fuel_share`: fuel
    consumption as a share of that while driving."""
    slot = world.slots[c, n]
    duration = time - slot.worked
    used = min(duration * k.fuel_per_s * fuel_share, slot.fuel)
    slot.fuel -= used
    world.days[c].fuel += used
    # Breakdowns are a Poisson process with a rate that grows with wear: the bus breaks down when the rate
    # integrated since its last breakdown, which service does not reset, reaches a unit exponential number.
    slot.hazard += duration * k.hazard_per_s * math.exp(k.wear_growth * (1.0 - slot.uptime))
    slot.uptime = max(slot.uptime - duration * k.uptime_per_s, 0.0)
    slot.worked = time


@compiled
def renew(k: Record, world: World, c: int, n: int) -> None:
    """Refuel and repair a bus."""
    slot = world.slots[c, n]
    slot.fuel = k.fuel_capacity
    slot.uptime = 1.0


@compiled
def draw_breakdown(world: World, c: int, n: int) -> None:
    """Draw the hazard at which a bus breaks down next."""
    slot = world.slots[c, n]
    slot.hazard = 0.0
    slot.hazard_limit = exponential(world.days[c].key, BREAKDOWN, n, slot.breakdowns)


@compiled
def schedule_next_trip(
    net: Network, k: Record, world: World, c: int, n: int, time: float, arrived: bool
) -> None:
    """Schedule the slot's next trip, `dispatch_window_s` before its departure or, if actions are holding
    times, at its departure. The bus waits at the trip's terminal; at the depot if no trip is left, the day
    begins, or the wait exceeds `depot_gap_s`. `arrived`: whether it has just finished a trip."""
    slot = world.slots[c, n]
    if slot.block == net.slot_first[n + 1]:
        slot.phase = DEPOT
        world.event_time[c, n] = np.inf
        return
    slot.trip = net.slot_trips[slot.block]
    slot.pattern = net.trip_pattern[slot.trip]
    slot.call = net.pattern_calls[slot.pattern]
    slot.held = 0.0
    slot.trip_factor = unit_lognormal(normal(world.days[c].key, TRIP, slot.trip, 0), k.trip_sd)
    ready = net.trip_departure[slot.trip] - (0.0 if k.holding else k.dispatch_window_s)
    if arrived:
        ready = max(ready, time + k.minimum_layover_s + net.trip_deadhead[slot.trip])
    elif n == k.late_bus:
        ready = net.trip_departure[slot.trip] + k.late_s
    ready = max(ready, k.start_s)
    slot.phase = DEPOT if not arrived or ready - time > k.depot_gap_s else TERMINAL
    if slot.phase == DEPOT and arrived:
        renew(k, world, c, n)
    world.event_time[c, n] = ready


@compiled
def depart(net: Network, k: Record, world: World, c: int, n: int, time: float) -> None:
    """Leave a call for the next one, and record headway and load."""
    slot, day, queue = world.slots[c, n], world.days[c], world.queues[c, world.slots[c, n].call]
    if queue.last_departure > 0.0:
        headway = time - queue.last_departure
        target = interpolate(net.target, slot.pattern, time)
        ratio = headway / target
        day.headways += 1
        if ratio < 0.25:
            day.bunched += 1
            day.bunching_events += slot.phase == DISPATCHED or slot.headway_ratio >= 0.25
        slot.headway_ratio = ratio
        day.headway_ratio += ratio
        day.headway_ratio_squared += ratio * ratio
        day.headway += headway
        day.headway_squared += headway * headway
        day.headway_target += headway * target
        call = world.calls[c, slot.call]
        call.headways += 1
        call.headway += headway
        call.headway_squared += headway * headway
        # Passengers whom an earlier bus left behind have waited since then and missed this bus too.
        day.queueing += queue.denied * headway
    queue.last_departure = time
    departure = net.trip_departure[slot.trip]
    day.schedule_deviation += abs(time - departure - interpolate(net.nominal, slot.call, departure))
    # Passengers who still wait when a bus leaves were left behind.
    day.denied += queue.waiting
    queue.denied = queue.waiting
    day.loads += 1
    day.load += slot.load
    world.loads[c, slot.load] += 1
    if slot.phase == DISPATCHED:
        slot.trip_left = time
        world.departed[c, slot.trip] = True
    following = world.calls[c, slot.call + 1]
    # From a terminal, another bus may have left since the decision, and skip the same stop.
    if slot.next_order == SKIP_NEXT and following.skipped:
        slot.next_order = 0
    following.skipped = slot.next_order == SKIP_NEXT
    slot.phase = DRIVING
    slot.left = time
    slot.held = 0.0
    slot.order = 0
    world.event_time[c, n] = time + link_time(net, k, world, c, n, time)


@compiled
def arrive(net: Network, k: Record, world: World, c: int, n: int, time: float) -> None:
    """Arrive at the next call: alight, then finish the trip, break down, or board."""
    slot, day = world.slots[c, n], world.days[c]
    charge_upkeep(k, world, c, n, time, 1.0)
    planned = n == day.breakdown_bus and time >= k.breakdown_s
    slot.call += 1
    order = slot.next_order
    slot.next_order = 0
    call = world.calls[c, slot.call]
    call.arrivals += 1
    call.load += slot.load
    call.load_squared += slot.load * slot.load
    share = net.alighting[slot.call, period_of(time)]
    alighting = 0
    if slot.load > 0:
        alighting = binomial(uniform(day.key, ALIGHTING, slot.trip, slot.call), slot.load, share)
        day.alighted += alighting
        change_load(day, slot, -alighting, time)
    if slot.call == net.pattern_calls[slot.pattern + 1] - 1:
        world.trip_time[c, slot.trip] = time - slot.trip_left
        world.last_finish[c, slot.pattern] = time
        slot.block += 1
        schedule_next_trip(net, k, world, c, n, time, True)
    elif planned or slot.fuel <= 0.0 or slot.hazard >= slot.hazard_limit:
        # On arrival only, because a bus has no events between calls.
        if planned:
            day.breakdown_bus = -1
        day.breakdowns += 1
        slot.breakdowns += 1
        draw_breakdown(world, c, n)
        unload_passengers(net, k, world, c, n, time)
        slot.phase = BROKEN
        world.event_time[c, n] = time + k.broken_s
    else:
        slot.phase = STANDING
        share = 1.0
        if order == SKIP_NEXT:
            share = 0.0
            day.skipped += 1
        elif order == LIMIT_NEXT:
            share = k.boarding_limit
            day.limited += 1
        slot.order = order
        dwell = alighting * k.alighting_s + board(net, k, world, c, n, time, share) * k.boarding_s
        if dwell > 0.0:
            dwell += k.fixed_dwell_s
        world.event_time[c, n] = time + dwell


@compiled
def leave_for_service(net: Network, k: Record, world: World, c: int, n: int, time: float) -> None:
    """Leave the line for the service centre. The bus will return to the same call."""
    slot = world.slots[c, n]
    # The towing of a broken bus is counted as a breakdown, not as a visit.
    if slot.phase != BROKEN:
        world.days[c].visits += 1
    unload_passengers(net, k, world, c, n, time)
    slot.phase = AWAY
    world.event_time[c, n] = time + k.service_s + 2.0 * net.detour[slot.call]


@compiled
def dispatch(k: Record, world: World, c: int, n: int, time: float) -> None:
    """Let a bus leave its terminal after the dispatch delay."""
    slot = world.slots[c, n]
    slot.phase = DISPATCHED
    delay = k.dispatch_s * exponential(world.days[c].key, DISPATCH, slot.trip, 0)
    world.event_time[c, n] = time + delay


@compiled
def may_restrict(net: Network, world: World, c: int, pattern: int, call: int, order: int) -> bool:
    """Return whether a bus that leaves `call` may skip the next stop or limit boarding there. The last stop
    of a trip must be served, and no two buses skip the same stop one after the other."""
    if call + 1 >= net.pattern_calls[pattern + 1] - 1:
        return False
    return bool(order != SKIP_NEXT or not world.calls[c, call + 1].skipped)


# Not inlined, to keep the code that decides every minute small.
@compiled_apart
def apply_holding(net: Network, k: Record, world: World, c: int, n: int, time: float, action: int) -> bool:
    """Hold a bus that is ready to leave, once per stop; return whether it was the bus's decision. `action`:
    holding time, ms, or SKIP_NEXT or LIMIT_NEXT, which act as 0 ms where the bus may not do that.

    There is no decision where the bus has been held already, at a stop that it skips, at one without control
    (all but every `control_every`-th), at a terminal from which the bus goes to service, and with a driver
    who does not comply.
    """
    slot = world.slots[c, n]
    at_terminal = slot.phase == TERMINAL
    if at_terminal and is_serviceable(k, world, c, n) and is_due_for_service(net, k, world, c, n):
        leave_for_service(net, k, world, c, n, time)
        return False
    passed = slot.call - net.pattern_calls[slot.pattern]
    decides = slot.complies and slot.held == 0.0 and slot.order != SKIP_NEXT and passed % k.control_every == 0
    if decides and action < 0 and may_restrict(net, world, c, slot.pattern, slot.call, action):
        slot.next_order = action
    slot.held = hold_s = 0.001 * max(action, 0) if decides else 0.0
    if at_terminal:
        dispatch(k, world, c, n, time + hold_s)
    elif hold_s > 0.0:
        world.days[c].held += hold_s
        world.event_time[c, n] = time + hold_s
    else:
        depart(net, k, world, c, n, time)
    return bool(decides)


@compiled
def apply_action(net: Network, k: Record, world: World, c: int, n: int, time: float, action: int) -> bool:
    """Apply the action chosen for slot `n` of copy `c` when its bus is ready to leave: depart, hold or get
    service. Return whether the action was used."""
    if k.holding:
        return apply_holding(net, k, world, c, n, time, action)
    slot = world.slots[c, n]
    if action == MOVE or (action == SERVICE_CENTER and not is_serviceable(k, world, c, n)):
        if slot.phase == TERMINAL:
            dispatch(k, world, c, n, time)
        else:
            depart(net, k, world, c, n, time)
    elif action == SERVICE_CENTER:
        leave_for_service(net, k, world, c, n, time)
    else:
        slot.held += k.hold_s
        world.days[c].held += k.hold_s if slot.phase == STANDING else 0.0
        world.event_time[c, n] = time + k.hold_s
    return True


@compiled
def return_to_line(net: Network, k: Record, world: World, c: int, n: int, time: float) -> None:
    """Return from the service centre to the call that the bus left."""
    slot = world.slots[c, n]
    renew(k, world, c, n)
    slot.worked = time
    # A bus that had not begun its trip still has to be dispatched.
    first = slot.call == net.pattern_calls[slot.pattern] and not world.departed[c, slot.trip]
    slot.phase = TERMINAL if first else STANDING
    world.event_time[c, n] = time


@compiled
def process_event(net: Network, k: Record, world: World, c: int, n: int, time: float, action: int) -> bool:
    """Process the slot's event at `time`; return whether it was a decision, which used the action."""
    slot = world.slots[c, n]
    if slot.phase == DRIVING:
        arrive(net, k, world, c, n, time)
        return False
    if slot.phase == AWAY:
        return_to_line(net, k, world, c, n, time)
        return False
    if slot.phase == BROKEN:
        leave_for_service(net, k, world, c, n, time)
        return False
    if slot.phase == DEPOT:
        renew(k, world, c, n)
        slot.phase = TERMINAL
        slot.since = time
    if slot.phase == STANDING:
        charge_upkeep(k, world, c, n, time, k.idle_share)
    else:
        slot.worked = time
    # Passengers who have come during the dwell still board; a bus at a stop decides once there are none.
    boarded = board(net, k, world, c, n, time, 1.0 if slot.order == 0 else 0.0)
    if slot.phase == TERMINAL:
        return apply_action(net, k, world, c, n, time, action)
    if boarded > 0:
        world.event_time[c, n] = time + boarded * k.boarding_s
        return False
    if slot.phase == DISPATCHED:
        depart(net, k, world, c, n, time)
        return False
    return apply_action(net, k, world, c, n, time, action)


@compiled
def process_event_traced(
    net: Network, k: Record, world: World, c: int, n: int, time: float, action: int, trace: Trace
) -> bool:
    """Process the slot's event like `process_event`, and record times, boardings and load in the trace."""
    slot, day = world.slots[c, n], world.days[c]
    arriving, boarded = slot.phase == DRIVING, day.boarded
    entry = trace.first[slot.trip] + slot.call + arriving - net.pattern_calls[slot.pattern]
    used = process_event(net, k, world, c, n, time, action)
    trace.boarded[c, entry] += day.boarded - boarded
    if arriving:
        trace.arrived[c, entry] = time
    elif slot.phase == DRIVING:
        trace.left[c, entry] = time
        trace.load[c, entry] = slot.load
    return used


# A separate function: numba would compile everything that `advance` calls for the literal -1 as well.
@compiled
def next_event(world: World, c: int, first: int, last: int, until: float) -> tuple[int, float]:
    """Return the slot in [first, last) with the next event before `until`, and its time; else (-1, until)."""
    soonest, time = -1, until
    for n in range(first, last):
        if world.event_time[c, n] < time:
            soonest, time = n, world.event_time[c, n]
    return soonest, time


@compiled
def advance(
    net: Network,
    k: Record,
    world: World,
    c: int,
    actions: NDArray[np.int64],
    acting: NDArray[np.bool_],
    trace: Trace,
) -> None:
    """Process all events of copy c before the end of the control interval, one line after the other, in order
    of time."""
    day = world.days[c]
    traced = trace.arrived.shape[1] > 0
    if traced and day.tick == 0:
        trace.arrived[c] = np.nan
        trace.left[c] = np.nan
        trace.boarded[c] = 0.0
        trace.load[c] = np.nan
    until = day.now + k.tick_s
    for line in range(net.line_slots.shape[0] - 1):
        first, last = net.line_slots[line], net.line_slots[line + 1]
        while True:
            soonest, time = next_event(world, c, first, last, until)
            if soonest < 0:
                break
            if traced:
                used = process_event_traced(net, k, world, c, soonest, time, actions[soonest], trace)
            else:
                used = process_event(net, k, world, c, soonest, time, actions[soonest])
            acting[soonest] = acting[soonest] or used
    day.now = until
    day.tick += 1
