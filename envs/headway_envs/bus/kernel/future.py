"""New futures from the same present: what was drawn in advance is drawn again from another seed."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from headway_envs.bus.kernel.compiled import compiled, compiled_allocating
from headway_envs.bus.kernel.curves import interpolate
from headway_envs.bus.kernel.day import draw_congestion
from headway_envs.bus.kernel.draws import (
    HAZARD_LEFT,
    PATIENCE_LEFT,
    TRIP,
    exponential,
    normal,
    unit_lognormal,
)
from headway_envs.bus.kernel.layout import Network, Record, World
from headway_envs.bus.kernel.motion import congestion_factor
from headway_envs.bus.kernel.passengers import draw_next_arrival, update_queue
from headway_envs.bus.kernel.upkeep import upkeep_potential
from headway_envs.keyed_random import episode_key


@compiled
def _redraw_queue(net: Network, k: Record, world: World, c: int, call: int, pattern: int) -> None:
    """Draw the next arrival and the remaining patience of waiting passengers, which are memoryless, and the
    random factor of the hour."""
    day, queue, first = world.days[c], world.queues[c, call], net.queue_first[call]
    for i in range(queue.waiting):
        if world.leaves_at[c, first + i] < np.inf:
            target = interpolate(net.target, pattern, world.arrived_at[c, first + i])
            left = exponential(day.key, PATIENCE_LEFT, call, i) * k.competing_share * target
            world.leaves_at[c, first + i] = day.now + left
    queue.drawn = 0
    queue.hour = -1
    queue.next_arrival = day.now
    draw_next_arrival(net, k, world, c, call)


@compiled
def _redraw_copy(net: Network, k: Record, world: World, c: int, seed: np.uint64) -> None:
    day = world.days[c]
    # Queues are brought up to date only when a bus comes: those who have arrived so far did arrive.
    for p in range(net.pattern_calls.shape[0] - 1):
        for call in range(net.pattern_calls[p], net.pattern_calls[p + 1]):
            update_queue(net, k, world, c, call, p, day.now)
    day.seed = seed
    day.key = episode_key(seed, day.episode)
    for p in range(net.pattern_calls.shape[0] - 1):
        for call in range(net.pattern_calls[p], net.pattern_calls[p + 1]):
            _redraw_queue(net, k, world, c, call, p)
    for n in range(world.slots.shape[1]):
        slot = world.slots[c, n]
        slot.hazard_limit = slot.hazard + exponential(day.key, HAZARD_LEFT, n, slot.breakdowns)
        if not world.departed[c, slot.trip]:
            slot.trip_factor = unit_lognormal(normal(day.key, TRIP, slot.trip, 0), k.trip_sd)
        # The source may not use the potential, and then does not keep it up to date.
        slot.upkeep_ahead = upkeep_potential(net, k, world, c, n)
    # Rounded, so that a second redraw finds the same level to the last bit.
    level = round(congestion_factor(k, world, c, day.now), 9)
    draw_congestion(k, world, c)
    change = level / congestion_factor(k, world, c, day.now)
    for edge in range(world.congestion.shape[1]):
        world.congestion[c, edge] *= change


@compiled_allocating
def redraw(net: Network, settings: NDArray[Any], world: World, seeds: NDArray[np.uint64]) -> None:
    """Draw the future of every copy from `seeds` (C,), given its present.

    Unchanged are the day's demand factor, the drivers who comply with holding, the passengers waiting and
    aboard, and the end times of dwells, drives and dispatch delays that have begun, which rules can see too.
    Travel times continue from their present level with the variation of another day. A second redraw replaces
    the first completely.
    """
    for c in range(seeds.shape[0]):
        _redraw_copy(net, settings[0], world, c, seeds[c])
