"""Whom the service centre takes, and what upkeep is still to cost: the potential that `reward.foresee_upkeep`
adds to rewards.

A potential-based change of the reward leaves the ranking of policies as it is (Ng, Harada and Russell 1999,
"Policy invariance under reward transformations"); taken undiscounted, its sum over a day is a constant.
"""

import numpy as np
from numpy.typing import NDArray

from headway_envs.bus.kernel.compiled import compiled
from headway_envs.bus.kernel.layout import AWAY, DEPOT, PAY_LINE, PAY_OWN, PAY_TEAM, Network, Record, World


@compiled
def is_serviceable(k: Record, world: World, c: int, n: int) -> bool:
    """Whether the service centre would take the slot as it is now."""
    slot = world.slots[c, n]
    level = min(slot.fuel / k.fuel_capacity, slot.uptime)
    return bool(k.service_below >= 1.0 or level < k.service_below)


@compiled
def _low_until(start: float, end: float, level: float, fall: float) -> float:
    """Integral of a level that falls by `fall` a second from `level` now, and stays at 0, from `start` to
    `end` seconds ahead."""
    empty = level / fall
    first, last = min(start, empty), min(end, empty)
    return (last - first) * (level - 0.5 * fall * (first + last))


@compiled
def upkeep_ahead(net: Network, k: Record, world: World, c: int, n: int) -> float:
    """Minus the reward that the slot is to lose by low fuel and wear, and by a breakdown without fuel, if it
    drives all its planned work until it is next at the depot without going to service; 0 or less."""
    slot = world.slots[c, n]
    if slot.phase == DEPOT and slot.block == net.slot_first[n + 1]:
        return 0.0
    renewed = slot.phase == DEPOT or slot.phase == AWAY
    fuel = 1.0 if renewed else slot.fuel / k.fuel_capacity
    uptime = 1.0 if renewed else slot.uptime
    burn, wear = k.fuel_per_s / k.fuel_capacity, k.uptime_per_s
    work = max(net.trip_work_left[net.slot_trips[slot.block]] - slot.place, 0.0)
    end = min(work, fuel / burn)
    low = max(min((fuel - k.warning) / burn, (uptime - k.warning) / wear), 0.0)
    cost = k.breakdown_cost if work > fuel / burn else 0.0
    if end > low:
        level = _low_until(low, end, fuel, burn) + _low_until(low, end, uptime, wear)
        cost += k.weight_maintenance * (end - low - 0.5 * level) / k.tick_s
    return -cost


@compiled
def foresee(net: Network, k: Record, world: World, c: int, rewards: NDArray[np.float32]) -> None:
    """Add the change of each slot's potential to rewards (N,): its own, or the mean of its line or the team.
    At the end of the day all potentials are 0."""
    over, total = world.days[c].now >= k.end_s, 0.0
    for line in range(net.line_slots.shape[0] - 1):
        first, last = net.line_slots[line], net.line_slots[line + 1]
        of_line = 0.0
        for n in range(first, last):
            slot = world.slots[c, n]
            potential = 0.0 if over else upkeep_ahead(net, k, world, c, n)
            change = potential - slot.upkeep_ahead
            slot.upkeep_ahead = potential
            of_line += change
            if k.scope == PAY_OWN:
                rewards[n] += change
        if k.scope == PAY_LINE:
            for n in range(first, last):
                rewards[n] += of_line / (last - first)
        total += of_line
    if k.scope == PAY_TEAM:
        for n in range(rewards.shape[0]):
            rewards[n] += total / rewards.shape[0]
