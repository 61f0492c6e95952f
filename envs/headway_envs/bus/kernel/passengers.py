"""Queues: who waits where since when, exactly."""

import numpy as np
from numpy.typing import NDArray

from headway_envs.bus.kernel.compiled import compiled
from headway_envs.bus.kernel.curves import at, bin_of
from headway_envs.bus.kernel.draws import (
    ARRIVAL,
    DEMAND_HOUR,
    PATIENCE,
    exponential,
    normal,
    unit_gamma,
)
from headway_envs.bus.kernel.layout import BIN_S, WAIT_BINS, Network, Record, World
from headway_envs.keyed_random import uniform


@compiled
def draw_next(net: Network, k: Record, world: World, c: int, call: int) -> None:
    """Draw the queue's next arrival, a Poisson process whose rate is the bin's times the day's and the stop
    hour's factor: a unit exponential is used up along the rate."""
    day, queue = world.days[c], world.queues[c, call]
    left = exponential(day.key, ARRIVAL, call, queue.drawn)
    queue.drawn += 1
    time, bins = queue.next_arrival, net.arrival_rate.shape[1]
    while time < k.end_s:
        bin_ = bin_of(time, k.start_s, bins)
        hour = int(time // 3600.0)
        if hour != queue.hour:
            queue.hour = hour
            queue.hour_factor = unit_gamma(normal(day.key, DEMAND_HOUR, call, hour), k.demand_stop_hour_sd)
        rate = net.arrival_rate[call, bin_] * day.demand_factor * queue.hour_factor
        edge = k.start_s + (bin_ + 1) * BIN_S
        if rate * (edge - time) > left:
            queue.next_arrival = time + left / rate
            return
        left -= rate * (edge - time)
        time = edge
    queue.next_arrival = np.inf


@compiled
def catch_up(net: Network, k: Record, world: World, c: int, call: int, pattern: int, time: float) -> None:
    """Let all passengers who come to the call up to `time` join its queue, and those whose competing service
    has come leave it."""
    day, queue = world.days[c], world.queues[c, call]
    first = net.queue_first[call]
    room = net.queue_first[call + 1] - first
    while queue.next_arrival <= time:
        arrival = queue.next_arrival
        mine = uniform(day.key, PATIENCE, call, queue.drawn)
        leaves = np.inf
        if mine >= k.captive_arrivals:
            share = (mine - k.captive_arrivals) / (1.0 - k.captive_arrivals)
            leaves = arrival - np.log(1.0 - share) * k.competing_share * at(net.target, pattern, arrival)
        day.arrived += 1
        draw_next(net, k, world, c, call)
        if leaves <= time or queue.waiting == room:
            day.lost += 1
        else:
            world.arrived_at[c, first + queue.waiting] = arrival
            world.leaves_at[c, first + queue.waiting] = leaves
            queue.waiting += 1
    kept, denied = 0, 0
    for i in range(queue.waiting):
        if world.leaves_at[c, first + i] > time:
            if kept != i:
                world.arrived_at[c, first + kept] = world.arrived_at[c, first + i]
                world.leaves_at[c, first + kept] = world.leaves_at[c, first + i]
            kept += 1
            denied += i < queue.denied
    day.lost += queue.waiting - kept
    queue.waiting = kept
    queue.denied = denied


@compiled
def count_wait(waits: NDArray[np.uint32], wait: float) -> None:
    """Add one wait, in s, to a histogram of one-second bins."""
    waits[min(int(wait), WAIT_BINS - 1)] += 1


@compiled
def board(net: Network, k: Record, world: World, c: int, n: int, time: float) -> int:
    """Those who wait at the slot's call board, first come first served; returns how many."""
    slot, day = world.slots[c, n], world.days[c]
    catch_up(net, k, world, c, slot.call, slot.pattern, time)
    queue = world.queues[c, slot.call]
    boarding = min(queue.waiting, k.capacity - slot.load)
    if boarding == 0:
        return 0
    first = net.queue_first[slot.call]
    for i in range(boarding):
        wait = time - world.arrived_at[c, first + i]
        day.wait += wait
        if world.leaves_at[c, first + i] == np.inf:
            day.captive_boarded += 1.0
            day.captive_wait += wait
        count_wait(world.waits[c], wait)
    for i in range(boarding, queue.waiting):
        world.arrived_at[c, first + i - boarding] = world.arrived_at[c, first + i]
        world.leaves_at[c, first + i - boarding] = world.leaves_at[c, first + i]
    queue.waiting -= boarding
    queue.denied = max(queue.denied - boarding, 0)
    day.boarded += boarding
    change_load(day, slot, boarding, time)
    return int(boarding)


@compiled
def change_load(day: Record, slot: Record, change: int, time: float) -> None:
    """Change the slot's load and charge the passenger seconds aboard until now."""
    day.ride += slot.load * (time - slot.since)
    slot.since = time
    slot.load += change


@compiled
def put_off(net: Network, k: Record, world: World, c: int, n: int, time: float) -> None:
    """All passengers alight before their stop and queue again; their wait begins anew. Those for whom the
    stop has no room walk away and count as lost."""
    slot, day = world.slots[c, n], world.days[c]
    if slot.load == 0:
        return
    catch_up(net, k, world, c, slot.call, slot.pattern, time)
    queue = world.queues[c, slot.call]
    first = net.queue_first[slot.call]
    room = net.queue_first[slot.call + 1] - first - queue.waiting
    again = min(slot.load, room)
    for _ in range(again):
        world.arrived_at[c, first + queue.waiting] = time
        world.leaves_at[c, first + queue.waiting] = np.inf
        queue.waiting += 1
    day.alighted += slot.load
    day.arrived += slot.load
    day.requeued += slot.load
    day.lost += slot.load - again
    change_load(day, slot, -slot.load, time)
