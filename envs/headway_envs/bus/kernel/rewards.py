"""Reward of a control interval and its four components: service q, efficiency e, maintenance m, regularity
c."""

import numpy as np
from numpy.typing import NDArray

from headway_envs.bus.kernel.compiled import compiled
from headway_envs.bus.kernel.curves import bin_of
from headway_envs.bus.kernel.layout import (
    BROKEN,
    DEPOT,
    DRIVING,
    SCOPE_LINE,
    SCOPE_TEAM,
    STANDING,
    Network,
    Record,
    World,
)
from headway_envs.bus.kernel.passengers import update_queue
from headway_envs.bus.kernel.spacing import COUNTED, LEFT_OUT


@compiled
def efficiency(k: Record, slot: Record) -> float:
    """Return e of one bus on the route: minus the squared excess of the occupancy over 0.9, scaled to [-1,
    0]. With `low_occupancy`, also minus the squared shortfall below it."""
    occupancy = slot.load / k.capacity
    over = max(occupancy - 0.9, 0.0) / 0.1
    under = max(k.low_occupancy - occupancy, 0.0) / k.low_occupancy if k.low_occupancy > 0.0 else 0.0
    return float(-over * over - under * under)


@compiled
def maintenance(k: Record, slot: Record) -> float:
    """Return m of one bus: -1 if broken down or without fuel; (fuel + uptime)/2 - 1 below a warning level;
    else 0."""
    fuel = slot.fuel / k.fuel_capacity
    if slot.phase == BROKEN or fuel <= 0.0:
        return -1.0
    if fuel < k.warning or slot.uptime < k.warning:
        return float(0.5 * (fuel + slot.uptime) - 1.0)
    return 0.0


@compiled
def service(net: Network, k: Record, world: World, c: int, line: int) -> float:
    """Return q of a line, at least -3: 1 - number of waiting passengers / their number under a regular
    service. Passengers left behind by a bus count twice."""
    now, waiting = world.days[c].now, 0
    for p in range(net.line_patterns[line], net.line_patterns[line + 1]):
        for call in range(net.pattern_calls[p], net.pattern_calls[p + 1] - 1):
            queue = world.queues[c, call]
            # Other queues are empty and need no update.
            if queue.next_arrival <= now or queue.waiting > 0:
                update_queue(net, k, world, c, call, p, now)
                waiting += queue.waiting + queue.denied
    world.lines[c, line].waiting = waiting
    bins = net.regular_waiting.shape[1]
    # The bin of the control interval that has just ended, also if `now` begins the next one.
    regular = max(net.regular_waiting[line, bin_of(now - 1.0, k.start_s, bins)], 1.0)
    return float(max(1.0 - waiting / regular, -3.0))


@compiled
def _score_line(net: Network, k: Record, world: World, c: int, line: int) -> None:
    """Set the components of a line: q, and means of e over its buses on the route, of m over its buses
    outside the depot, and of c over its buses scheduled in service."""
    record = world.lines[c, line]
    record.service = service(net, k, world, c, line)
    crowding, upkeep, regular = 0.0, 0.0, 0.0
    on_route, alive, counted = 0, 0, 0
    for n in range(net.line_slots[line], net.line_slots[line + 1]):
        slot = world.slots[c, n]
        if slot.phase == DEPOT:
            continue
        alive += 1
        upkeep += maintenance(k, slot)
        if slot.phase == DRIVING or slot.phase == STANDING:
            on_route += 1
            crowding += efficiency(k, slot)
        if slot.counted != LEFT_OUT:
            counted += 1
            regular += slot.regularity
    record.alive, record.on_route, record.counted = alive, on_route, counted
    record.efficiency = crowding / max(on_route, 1)
    record.maintenance = upkeep / max(alive, 1)
    record.regularity = regular / max(counted, 1)


@compiled
def _weighted_sum(
    k: Record, service: float, efficiency: float, maintenance: float, regularity: float
) -> float:
    """Return the reward: the weighted sum of its four components."""
    return float(
        k.weight_service * service
        + k.weight_efficiency * efficiency
        + k.weight_maintenance * maintenance
        + k.weight_regularity * regularity
    )


@compiled
def _assign_line_rewards(net: Network, k: Record, world: World, c: int, rewards: NDArray[np.float32]) -> None:
    """Give each slot the reward of its line."""
    for line in range(net.line_slots.shape[0] - 1):
        record = world.lines[c, line]
        rewards[net.line_slots[line] : net.line_slots[line + 1]] = _weighted_sum(
            k, record.service, record.efficiency, record.maintenance, record.regularity
        )


@compiled
def _assign_own_rewards(net: Network, k: Record, world: World, c: int, rewards: NDArray[np.float32]) -> None:
    """Give each bus the reward of its own e, m and c with its line's q, by `scale_service` once for each bus
    of the line; 0 at the depot.

    Holding a bus changes two spacings: its own and that of the bus behind it. `follower_share` adds a share
    of the difference between the follower's c and its own.
    """
    for line in range(net.line_slots.shape[0] - 1):
        first, last = net.line_slots[line], net.line_slots[line + 1]
        record = world.lines[c, line]
        served = record.service * (record.alive if k.scale_service else 1)
        for n in range(first, last):
            slot = world.slots[c, n]
            if slot.phase == DEPOT:
                rewards[n] = 0.0
                continue
            on_route = slot.phase == DRIVING or slot.phase == STANDING
            crowding = efficiency(k, slot) if on_route else 0.0
            rewards[n] = _weighted_sum(k, served, crowding, maintenance(k, slot), slot.regularity)
        if k.follower_share > 0.0:
            for n in range(first, last):
                behind = world.slots[c, n]
                if behind.leader >= 0 and behind.counted == COUNTED:
                    ahead = world.slots[c, behind.leader]
                    follower_part = k.follower_share * (behind.regularity - ahead.regularity)
                    rewards[behind.leader] += k.weight_regularity * follower_part


@compiled
def assign_rewards(net: Network, k: Record, world: World, c: int, rewards: NDArray[np.float32]) -> None:
    """Fill the rewards (N,) of the past interval, and add to the day's totals. The team's components are
    means over the lines, weighted by their numbers of slots. Spacings must be up to date."""
    day, slots = world.days[c], world.slots.shape[1]
    q, e, m, r = 0.0, 0.0, 0.0, 0.0
    for line in range(net.line_slots.shape[0] - 1):
        _score_line(net, k, world, c, line)
        record = world.lines[c, line]
        weight = (net.line_slots[line + 1] - net.line_slots[line]) / slots
        q += weight * record.service
        e += weight * record.efficiency
        m += weight * record.maintenance
        r += weight * record.regularity
    team = _weighted_sum(k, q, e, m, r)
    day.service += q
    day.efficiency += e
    day.maintenance += m
    day.regularity += r
    day.reward += team
    if k.scope == SCOPE_TEAM:
        rewards[:] = team
    elif k.scope == SCOPE_LINE:
        _assign_line_rewards(net, k, world, c, rewards)
    else:
        _assign_own_rewards(net, k, world, c, rewards)
