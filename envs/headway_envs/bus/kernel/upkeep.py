"""Admission to the service centre, when a dispatcher sends buses there, and the potential of
`reward.foresee_upkeep`: the future cost of upkeep.

A potential-based change of the reward leaves the ranking of policies unchanged (Ng, Harada and Russell 1999,
"Policy invariance under reward transformations"). Undiscounted, its sum over a day is a constant.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from headway_envs.bus.kernel.compiled import compiled
from headway_envs.bus.kernel.layout import (
    AWAY,
    DEPOT,
    SCOPE_LINE,
    SCOPE_OWN,
    SCOPE_TEAM,
    Network,
    Record,
    World,
)

FUEL_MARGIN = 1.25
"""Safety margin on fuel: the driving time that a bus's fuel lasts for is divided by this factor."""
NEAR_S = 60.0
"""Tolerance, s, for terminals near a service centre: a terminal is near if its detour exceeds the shortest
detour of its line by at most this time."""
MIN_WORN_SHARE = 0.5
"""Share of the planned driving time until the depot that a bus must spend below the warning level of uptime
to be sent to service."""


@compiled
def is_serviceable(k: Record, world: World, c: int, n: int) -> bool:
    """Return whether the service centre accepts the bus in its present state."""
    slot = world.slots[c, n]
    level = min(slot.fuel / k.fuel_capacity, slot.uptime)
    return bool(k.service_below >= 1.0 or level < k.service_below)


@compiled
def is_due_for_service(net: Network, k: Record, world: World, c: int, n: int) -> bool:
    """Return whether the bus should go to service at its current terminal.

    Inputs are the driving time until the bus's next stay at the depot and the terminals of its line nearest
    to a service centre. A bus at such a terminal is sent if its fuel, with a margin, lasts neither to the
    depot nor for a round trip (twice its line's longest trip), or if its uptime would fall below the warning
    level within a round trip and early enough before the depot (`MIN_WORN_SHARE`). At any other terminal a
    bus is sent only if its fuel lasts neither to the depot nor for one more trip.
    """
    slot, line = world.slots[c, n], net.slot_line[n]
    trip, to_drive = net.line_trip[line], net.trip_work_left[slot.trip]
    fuel_range = slot.fuel / k.fuel_per_s / FUEL_MARGIN
    wear_range = (slot.uptime - k.warning) / k.uptime_per_s
    near = net.detour[slot.call] <= net.line_detour[line] + NEAR_S
    soon = fuel_range < min((2.0 if near else 1.0) * trip, to_drive)
    worn = near and wear_range < min(2.0 * trip, (1.0 - MIN_WORN_SHARE) * to_drive)
    return bool(soon or worn)


@compiled
def find_due_for_service(net: Network, settings: NDArray[Any], world: World, due: NDArray[np.bool_]) -> None:
    """Fill `due` (C, N) with `is_due_for_service` of every slot."""
    for c in range(due.shape[0]):
        for n in range(due.shape[1]):
            due[c, n] = is_due_for_service(net, settings[0], world, c, n)


@compiled
def _level_integral(start: float, end: float, level: float, fall: float) -> float:
    """Return the integral, from `start` to `end` s from now, of a level that falls from `level` by `fall` per
    s and stays at 0."""
    empty = level / fall
    first, last = min(start, empty), min(end, empty)
    return (last - first) * (level - 0.5 * fall * (first + last))


@compiled
def upkeep_potential(net: Network, k: Record, world: World, c: int, n: int) -> float:
    """Return the potential of a slot, 0 or less: minus the reward that the bus will lose by low fuel, wear
    and running out of fuel, if it drives all planned work up to its next stay at the depot without
    service."""
    slot = world.slots[c, n]
    if slot.phase == DEPOT and slot.block == net.slot_first[n + 1]:
        return 0.0
    renewed = slot.phase == DEPOT or slot.phase == AWAY
    fuel = 1.0 if renewed else slot.fuel / k.fuel_capacity
    uptime = 1.0 if renewed else slot.uptime
    burn, wear = k.fuel_per_s / k.fuel_capacity, k.uptime_per_s
    work = max(net.trip_work_left[net.slot_trips[slot.block]] - slot.place, 0.0)
    end = min(work, fuel / burn)
    # Time until the first of both levels falls below the warning level, where m becomes negative.
    low = max(min((fuel - k.warning) / burn, (uptime - k.warning) / wear), 0.0)
    cost = k.breakdown_cost if work > fuel / burn else 0.0
    if end > low:
        # Below it, m is (fuel + uptime) / 2 - 1, paid once per control interval.
        level = _level_integral(low, end, fuel, burn) + _level_integral(low, end, uptime, wear)
        cost += k.weight_maintenance * (end - low - 0.5 * level) / k.tick_s
    return -cost


@compiled
def shape_rewards(net: Network, k: Record, world: World, c: int, rewards: NDArray[np.float32]) -> None:
    """Add potential-based shaping to rewards (N,): the change of the slot's potential, of its line's mean or
    of the team's mean, by `scope`. Potentials are 0 at the end of the day."""
    over, total = world.days[c].now >= k.end_s, 0.0
    for line in range(net.line_slots.shape[0] - 1):
        first, last = net.line_slots[line], net.line_slots[line + 1]
        of_line = 0.0
        for n in range(first, last):
            slot = world.slots[c, n]
            potential = 0.0 if over else upkeep_potential(net, k, world, c, n)
            change = potential - slot.upkeep_ahead
            slot.upkeep_ahead = potential
            of_line += change
            if k.scope == SCOPE_OWN:
                rewards[n] += change
        if k.scope == SCOPE_LINE:
            for n in range(first, last):
                rewards[n] += of_line / (last - first)
        total += of_line
    if k.scope == SCOPE_TEAM:
        for n in range(rewards.shape[0]):
            rewards[n] += total / rewards.shape[0]
