"""Reset of a copy at the start of a service day, and its metrics at the end. The events between are those
of `motion`, simulated by `motion.advance`."""

import math

import numpy as np
from numpy.typing import NDArray

from headway_envs.bus.kernel.compiled import compiled, compiled_allocating
from headway_envs.bus.kernel.draws import (
    COMPLIANCE,
    DAY,
    DEMAND_DAY,
    EVENING,
    NETWORK,
    normal,
    unit_lognormal,
)
from headway_envs.bus.kernel.layout import BIN_S, Network, Record, World
from headway_envs.bus.kernel.motion import draw_breakdown, renew, schedule_next_trip
from headway_envs.bus.kernel.passengers import count_wait, draw_next_arrival, update_queue
from headway_envs.keyed_random import episode_key, uniform


@compiled
def draw_congestion(k: Record, world: World, c: int) -> None:
    """Draw the travel-time factors of the day: a factor of the whole day, the evening peak of weekdays, and
    an autoregressive factor of the network."""
    key = world.days[c].key
    day_factor = unit_lognormal(normal(key, DAY, 0, 0), k.day_sd)
    evening = k.evening_peak * uniform(key, EVENING, 0, 0) if k.weekday else 0.0
    correlation = math.exp(-BIN_S / 3600.0)
    network = normal(key, NETWORK, 0, 0)
    for edge in range(world.congestion.shape[1]):
        hour = (k.start_s + edge * BIN_S) / 3600.0
        shape = min(max(min(hour - 15.5, 19.5 - hour), 0.0), 1.0)
        # Divided out, so that the evening peak does not change the mean.
        mean_factor = 1.0 + 0.5 * k.evening_peak * shape if k.weekday else 1.0
        factor = day_factor * (1.0 + evening * shape) / mean_factor
        world.congestion[c, edge] = factor * unit_lognormal(network, k.network_sd)
        # Scaled such that the variance stays 1.
        innovation = math.sqrt(1.0 - correlation * correlation) * normal(key, NETWORK, edge + 1, 0)
        network = correlation * network + innovation


@compiled_allocating
def begin_day(net: Network, k: Record, world: World, c: int, seed: np.uint64, episode: int) -> None:
    """Reset copy c to the start of day `episode`."""
    world.days[c : c + 1] = np.zeros(1, world.days.dtype)
    day = world.days[c]
    day.seed = seed
    day.episode = episode
    day.key = episode_key(seed, episode)
    day.now = k.start_s
    day.breakdown_bus = k.breakdown_bus
    day.demand_factor = max(1.0 + k.demand_day_sd * normal(day.key, DEMAND_DAY, 0, 0), 0.0)
    world.departed[c] = False
    world.trip_time[c] = np.nan
    world.waits[c] = 0
    world.loads[c] = 0
    world.slots[c] = np.zeros(1, world.slots.dtype)[0]
    world.queues[c] = np.zeros(1, world.queues.dtype)[0]
    world.calls[c] = np.zeros(1, world.calls.dtype)[0]
    draw_congestion(k, world, c)
    for p in range(net.pattern_calls.shape[0] - 1):
        world.last_finish[c, p] = -1.0
        for call in range(net.pattern_calls[p], net.pattern_calls[p + 1]):
            world.queues[c, call].next_arrival = k.start_s
            world.queues[c, call].hour = -1
            draw_next_arrival(net, k, world, c, call)
    for n in range(world.slots.shape[1]):
        slot = world.slots[c, n]
        slot.block = net.slot_first[n]
        slot.complies = uniform(day.key, COMPLIANCE, n, 0) >= k.noncompliant_share
        slot.headway_ratio = 1.0
        slot.since = k.start_s
        slot.ahead = np.nan
        slot.behind = np.nan
        renew(k, world, c, n)
        draw_breakdown(world, c, n)
        schedule_next_trip(net, k, world, c, n, k.start_s, False)


@compiled
def quantile_of_counts(counts: NDArray[np.uint32], share: float) -> float:
    """Return the quantile of a histogram: the bin index below which `share` of the counts lie, linear within
    the bin."""
    total = 0
    for count in counts:
        total += count
    rank, below = share * total, 0.0
    for value in range(counts.shape[0]):
        if counts[value] > 0 and below + counts[value] >= rank:
            return float(value + (rank - below) / counts[value])
        below += counts[value]
    return 0.0


@compiled
def fill_call_metrics(world: World, c: int, metrics: NDArray[np.float64]) -> None:
    """Fill the dispersion of loads, and sd and coefficient of variation of headways: means over the calls."""
    loads, dispersion = 0, 0.0
    headways, spread, relative = 0, 0.0, 0.0
    for call in range(world.calls.shape[1]):
        at = world.calls[c, call]
        if at.arrivals >= 2:
            loads += 1
            mean = at.load / at.arrivals
            # A stop that only empty buses reach has no dispersion.
            dispersion += max(at.load_squared / at.arrivals - mean * mean, 0.0) / max(mean, 1e-9)
        if at.headways >= 2:
            headways += 1
            mean = at.headway / at.headways
            sd = math.sqrt(max(at.headway_squared / at.headways - mean * mean, 0.0))
            spread += sd
            relative += sd / max(mean, 1e-9)
    metrics[22] = dispersion / max(loads, 1)
    metrics[26] = spread / max(headways, 1)
    metrics[27] = relative / max(headways, 1)


@compiled_allocating
def end_day(net: Network, k: Record, world: World, c: int, metrics: NDArray[np.float64]) -> None:
    """Fill the episode metrics, in the order of `metrics.METRICS`. Passengers still waiting count with their
    wait so far."""
    day, ticks = world.days[c], max(world.days[c].tick, 1)
    still_waiting = 0
    for p in range(net.pattern_calls.shape[0] - 1):
        for call in range(net.pattern_calls[p], net.pattern_calls[p + 1] - 1):
            update_queue(net, k, world, c, call, p, day.now)
            first, queue = net.queue_first[call], world.queues[c, call]
            day.queueing += queue.denied * (day.now - queue.last_departure)
            for i in range(queue.waiting):
                wait = day.now - world.arrived_at[c, first + i]
                still_waiting += 1
                day.wait += wait
                if world.leaves_at[c, first + i] == np.inf:
                    day.captive_boarded += 1.0
                    day.captive_wait += wait
                count_wait(world.waits[c], wait)
    for n in range(world.slots.shape[1]):
        day.ride += world.slots[c, n].load * (day.now - world.slots[c, n].since)
    headways, boarded, loads = max(day.headways, 1), max(day.boarded, 1), max(day.loads, 1)
    mean_ratio = day.headway_ratio / headways
    spread = max(day.headway_ratio_squared / headways - mean_ratio * mean_ratio, 0.0)
    durations = world.trip_time[c][~np.isnan(world.trip_time[c])]
    waits, stops = max(day.boarded + still_waiting, 1), day.loads - np.sum(world.departed[c])
    metrics[0] = day.wait / waits / 60.0
    metrics[1] = quantile_of_counts(world.waits[c], 0.95) / 60.0
    metrics[2] = day.captive_wait / max(day.captive_boarded, 1.0) / 60.0
    # Random arrivals wait E[h^2] / (2 E[h]) on average for headways h, and E[h h*] / (2 E[h]) at targets h*.
    metrics[3] = (day.headway_squared - day.headway_target) / max(2.0 * day.headway, 1.0) / 60.0
    metrics[4] = math.sqrt(spread) / max(mean_ratio, 1e-9)
    metrics[5] = day.bunched / headways
    metrics[6] = day.denied
    metrics[7] = day.boarded
    metrics[8] = day.lost / max(day.arrived, 1)
    metrics[9] = day.load / loads / k.capacity
    # Loads are integers: a quantile within a bin is rounded down.
    metrics[10] = min(math.floor(quantile_of_counts(world.loads[c], 0.95)), k.capacity) / k.capacity
    metrics[11] = day.ride / boarded / 60.0
    metrics[12] = 0.0
    if durations.shape[0] > 0:
        metrics[12] = (np.percentile(durations, 90) - np.percentile(durations, 50)) / 60.0
    metrics[13] = day.held / max(durations.shape[0], 1) / 60.0
    metrics[14] = day.breakdowns
    metrics[15] = day.visits
    metrics[16] = day.fuel
    metrics[17] = day.service / ticks
    metrics[18] = day.efficiency / ticks
    metrics[19] = day.maintenance / ticks
    metrics[20] = day.regularity / ticks
    metrics[21] = day.held / max(stops, 1)
    fill_call_metrics(world, c, metrics)
    metrics[23] = metrics[0] + metrics[11]
    metrics[24] = day.queueing / waits / 60.0
    metrics[25] = day.schedule_deviation / loads
    metrics[28] = day.bunching_events
    metrics[29] = day.skipped / max(durations.shape[0], 1)
    metrics[30] = day.limited / max(durations.shape[0], 1)
    metrics[31] = day.reward
