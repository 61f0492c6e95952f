"""The reward of one control interval and its four components."""

import numpy as np
from numpy.typing import NDArray

from headway_envs.bus.kernel.compiled import compiled
from headway_envs.bus.kernel.curves import bin_of
from headway_envs.bus.kernel.layout import (
    BROKEN,
    DEPOT,
    DRIVING,
    PAY_LINE,
    PAY_TEAM,
    STANDING,
    Network,
    Record,
    World,
)
from headway_envs.bus.kernel.passengers import catch_up
from headway_envs.bus.kernel.spacing import COUNTED, LEFT_OUT


@compiled
def efficiency(k: Record, slot: Record) -> float:
    """e of one bus on its way: minus the squared excess of the occupancy over 0.9 (and, under the published
    band, the squared shortfall under `low_occupancy`), scaled to [-1, 0]."""
    occupancy = slot.load / k.capacity
    over = max(occupancy - 0.9, 0.0) / 0.1
    under = max(k.low_occupancy - occupancy, 0.0) / k.low_occupancy if k.low_occupancy > 0.0 else 0.0
    return float(-over * over - under * under)


@compiled
def maintenance(k: Record, slot: Record) -> float:
    """m of one bus: -1 broken down or without fuel; (fuel + uptime)/2 - 1 below a warning level; else 0."""
    fuel = slot.fuel / k.fuel_capacity
    if slot.phase == BROKEN or fuel <= 0.0:
        return -1.0
    if fuel < k.warning or slot.uptime < k.warning:
        return float(0.5 * (fuel + slot.uptime) - 1.0)
    return 0.0


@compiled
def service(net: Network, k: Record, world: World, c: int, line: int) -> float:
    """q of a line: 1 - waiting (denied twice) / what a regular service would leave waiting, at least -3."""
    now, waiting = world.days[c].now, 0
    for p in range(net.line_patterns[line], net.line_patterns[line + 1]):
        for call in range(net.pattern_calls[p], net.pattern_calls[p + 1] - 1):
            queue = world.queues[c, call]
            if queue.next_arrival <= now or queue.waiting > 0:
                catch_up(net, k, world, c, call, p, now)
                waiting += queue.waiting + queue.denied
    world.lines[c, line].waiting = waiting
    bins = net.regular_waiting.shape[1]
    regular = max(net.regular_waiting[line, bin_of(now - 1.0, k.start_s, bins)], 1.0)
    return float(max(1.0 - waiting / regular, -3.0))


@compiled
def _score_line(net: Network, k: Record, world: World, c: int, line: int) -> None:
    """The line's components: means over its buses (e: on their way; m: alive; c: scheduled in service)."""
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
def _weighted(k: Record, service: float, efficiency: float, maintenance: float, regularity: float) -> float:
    """The reward that four components come to."""
    return float(
        k.weight_service * service
        + k.weight_efficiency * efficiency
        + k.weight_maintenance * maintenance
        + k.weight_regularity * regularity
    )


@compiled
def _pay_lines(net: Network, k: Record, world: World, c: int, rewards: NDArray[np.float32]) -> None:
    """Each slot its line's reward."""
    for line in range(net.line_slots.shape[0] - 1):
        record = world.lines[c, line]
        rewards[net.line_slots[line] : net.line_slots[line + 1]] = _weighted(
            k, record.service, record.efficiency, record.maintenance, record.regularity
        )


@compiled
def _pay_own(net: Network, k: Record, world: World, c: int, rewards: NDArray[np.float32]) -> None:
    """Each bus its own components and its line's service; nothing at the depot.

    Holding a bus moves two spacings, its own and that of the bus behind it, of which its c takes
    `follower_share`."""
    for line in range(net.line_slots.shape[0] - 1):
        first, last = net.line_slots[line], net.line_slots[line + 1]
        for n in range(first, last):
            slot = world.slots[c, n]
            if slot.phase == DEPOT:
                rewards[n] = 0.0
                continue
            on_route = slot.phase == DRIVING or slot.phase == STANDING
            crowding = efficiency(k, slot) if on_route else 0.0
            rewards[n] = _weighted(
                k, world.lines[c, line].service, crowding, maintenance(k, slot), slot.regularity
            )
        if k.follower_share > 0.0:
            for n in range(first, last):
                behind = world.slots[c, n]
                if behind.leader >= 0 and behind.counted == COUNTED:
                    ahead = world.slots[c, behind.leader]
                    more = k.follower_share * (behind.regularity - ahead.regularity)
                    rewards[behind.leader] += k.weight_regularity * more


@compiled
def pay(net: Network, k: Record, world: World, c: int, rewards: NDArray[np.float32]) -> None:
    """Rewards (N,) of the interval just ended, and the day's accounts. The team's components are means over
    the lines, each weighted by its number of slots. Needs the spacings of now."""
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
    team = _weighted(k, q, e, m, r)
    day.service += q
    day.efficiency += e
    day.maintenance += m
    day.regularity += r
    day.reward += team
    if k.scope == PAY_TEAM:
        rewards[:] = team
    elif k.scope == PAY_LINE:
        _pay_lines(net, k, world, c, rewards)
    else:
        _pay_own(net, k, world, c, rewards)
