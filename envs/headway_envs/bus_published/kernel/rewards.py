"""Reward of a move, and the metrics of the day."""

import math

import numpy as np
from numpy.typing import NDArray

from headway_envs.bus_published.kernel.compiled import compiled
from headway_envs.bus_published.kernel.layout import Record


@compiled
def occupancy_cost(k: Record, occupancy: float) -> float:
    """Return o: the squared distance of the occupancy from the band, relative to that of the end of the
    range; 0 to 1."""
    if occupancy < k.low_occupancy:
        deviation = (k.low_occupancy - occupancy) / k.low_occupancy
    elif occupancy > k.high_occupancy:
        deviation = (occupancy - k.high_occupancy) / (1.0 - k.high_occupancy)
    else:
        return 0.0
    return float(min(deviation * deviation, 1.0))


@compiled
def record_arrival(k: Record, stop: Record, clock: float) -> float:
    """Record an arrival at a stop and return the regularity h there, 0 to 1. Intervals of 0 or less, which
    arise because clocks differ between buses, are left out."""
    if stop.arrivals > 0:
        interval = clock - stop.last
        if interval > 0.0:
            deviation = interval - k.target_headway_s
            stop.intervals += 1
            stop.squares += deviation * deviation
    stop.arrivals += 1
    stop.last = clock
    if stop.arrivals < 3 or stop.intervals < 2:
        return 0.0
    return float(1.0 - min(math.sqrt(stop.squares / stop.intervals) / k.target_headway_s, 1.0))


@compiled
def move_reward(k: Record, occupancy: float, uptime: float, regularity: float, efficiency: float) -> float:
    """Return the reward of a move, within [-1, 1]: the weighted mean of -o, u, h and t."""
    total = k.weight_occupancy + k.weight_uptime + k.weight_regularity + k.weight_efficiency
    benefit = k.weight_uptime * uptime + k.weight_regularity * regularity + k.weight_efficiency * efficiency
    return float(min(max((benefit - k.weight_occupancy * occupancy) / total, -1.0), 1.0))


@compiled
def fill_metrics(day: Record, metrics: NDArray[np.float64]) -> None:
    """Fill the episode metrics, in the order of `metrics.METRICS`."""
    moves = max(day.moves, 1)
    metrics[0] = day.reward
    metrics[1] = day.step
    metrics[2] = day.moves
    metrics[3] = day.waits
    metrics[4] = day.services
    metrics[5] = day.refused
    metrics[6] = day.occupancy / moves
    metrics[7] = day.uptime / moves
    metrics[8] = day.regularity / moves
    metrics[9] = day.efficiency / moves
