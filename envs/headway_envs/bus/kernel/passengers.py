"""Queues at the calls: exact arrival times of waiting passengers, boarding and alighting."""

import math

import numpy as np
from numpy.typing import NDArray

from headway_envs.bus.kernel.compiled import compiled
from headway_envs.bus.kernel.curves import bin_of, interpolate
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
def draw_next_arrival(net: Network, k: Record, world: World, c: int, call: int) -> None:
    """Draw the next arrival at a queue.

    Arrivals are a Poisson process. Its rate is that of the bin times the random factors of the day and of the
    stop's hour; a unit exponential number is used up along the integrated rate.
    """
    day, queue = world.days[c], world.queues[c, call]
    remaining = exponential(day.key, ARRIVAL, call, queue.drawn)
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
        if rate * (edge - time) > remaining:
            queue.next_arrival = time + remaining / rate
            return
        remaining -= rate * (edge - time)
        time = edge
    queue.next_arrival = np.inf


@compiled
def update_queue(net: Network, k: Record, world: World, c: int, call: int, pattern: int, time: float) -> None:
    """Bring a queue up to `time`: add the passengers who have arrived, and remove those whose competing
    service has come."""
    day, queue = world.days[c], world.queues[c, call]
    first = net.queue_first[call]
    room = net.queue_first[call + 1] - first
    # Queues are updated only when they are read: most stops are idle most of the time.
    while queue.next_arrival <= time:
        arrival = queue.next_arrival
        u = uniform(day.key, PATIENCE, call, queue.drawn)
        leaves = np.inf
        if u >= k.captive_arrivals:
            # One uniform number decides both: rescaled above the captive share, it is uniform again.
            share = (u - k.captive_arrivals) / (1.0 - k.captive_arrivals)
            target = interpolate(net.target, pattern, arrival)
            leaves = arrival - np.log(1.0 - share) * k.competing_share * target
        day.arrived += 1
        draw_next_arrival(net, k, world, c, call)
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
            # Passengers left behind by a bus are the first in the queue.
            denied += i < queue.denied
    day.lost += queue.waiting - kept
    queue.waiting = kept
    queue.denied = denied


@compiled
def count_wait(waits: NDArray[np.uint32], wait: float) -> None:
    """Add one wait, s, to a histogram of one-second bins."""
    waits[min(int(wait), WAIT_BINS - 1)] += 1


@compiled
def board(net: Network, k: Record, world: World, c: int, n: int, time: float, share: float) -> int:
    """Let at most a share of the waiting passengers, rounded up, board at the slot's call, first come first
    served; return their number."""
    slot, day = world.slots[c, n], world.days[c]
    update_queue(net, k, world, c, slot.call, slot.pattern, time)
    queue = world.queues[c, slot.call]
    # The tolerance absorbs rounding errors: 0.28 * 25 is 7.000000000000001.
    boarding = min(math.ceil(share * queue.waiting - 1e-9), k.capacity - slot.load)
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
    # The queue is a prefix of its storage, so the others have moved up.
    queue.waiting -= boarding
    day.queueing += min(boarding, queue.denied) * (time - queue.last_departure)
    queue.denied = max(queue.denied - boarding, 0)
    day.boarded += boarding
    change_load(day, slot, boarding, time)
    return int(boarding)


@compiled
def change_load(day: Record, slot: Record, change: int, time: float) -> None:
    """Change the load of a slot, and add the passenger seconds aboard up to `time` to the day's total."""
    day.ride += slot.load * (time - slot.since)
    slot.since = time
    slot.load += change


@compiled
def unload_passengers(net: Network, k: Record, world: World, c: int, n: int, time: float) -> None:
    """Let all passengers alight before their stop and queue again; their wait begins anew. Passengers for
    whom the queue storage has no room are lost."""
    slot, day = world.slots[c, n], world.days[c]
    if slot.load == 0:
        return
    update_queue(net, k, world, c, slot.call, slot.pattern, time)
    queue = world.queues[c, slot.call]
    first = net.queue_first[slot.call]
    room = net.queue_first[slot.call + 1] - first - queue.waiting
    requeued = min(slot.load, room)
    for _ in range(requeued):
        world.arrived_at[c, first + queue.waiting] = time
        # Passengers put off a bus wait for the line's next bus, not for the competing service.
        world.leaves_at[c, first + queue.waiting] = np.inf
        queue.waiting += 1
    day.alighted += slot.load
    day.arrived += slot.load
    day.requeued += slot.load
    day.lost += slot.load - requeued
    change_load(day, slot, -slot.load, time)
