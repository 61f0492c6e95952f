"""Compiled kernel: platoons, observations and state, from all vehicles' approaches, distances and speeds.

Axes: V vehicles, G approaches, K approaches of a junction, N slots, D = 2 (2 + 3 (K - 1)).
"""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from headway_envs.numba_setup import compiled, compiled_apart, drop_stale_cache

Floats = NDArray[np.float64]
Whole = NDArray[np.int64]

drop_stale_cache(Path(__file__).parent)

SIGHT_M = 100.0
"""Distance to the end of an approach from which on vehicles look equally far, m."""
STATE_PER_APPROACH = 3
"""Numbers of AVs and of human drivers, mean speed."""


@compiled
def _nearness(distance: float) -> float:
    """Return a distance scaled to [-1, 1]."""
    return 2.0 * min(max(distance / SIGHT_M, 0.0), 1.0) - 1.0


@compiled
def _quickness(speed: float, limit: float) -> float:
    """Return a speed scaled to [-1, 1]."""
    return 2.0 * min(max(speed / limit, 0.0), 1.0) - 1.0


@compiled
def _find_platoons(
    order: Whole, approach: Whole, distance: Floats, slot: Whole, tails: Whole, first: Whole
) -> None:
    """Fill `tails` (V,), the last vehicle of each vehicle's platoon, and `first` (G,), the place in `order`
    of the first vehicle before the end of each approach (-1: none).

    A platoon is an AV and the human drivers behind it up to the next AV, or the human drivers ahead of the
    first AV.
    """
    first[:] = -1
    for place in range(len(order) - 1, -1, -1):
        row = order[place]
        tails[row] = row
        if approach[row] < 0:
            continue
        if place + 1 < len(order):
            behind = order[place + 1]
            if approach[behind] == approach[row] and slot[behind] < 0:
                tails[row] = tails[behind]
        if distance[row] >= 0.0:
            first[approach[row]] = place


@compiled
def _observe_approach(
    order: Whole,
    approach: Whole,
    distance: Floats,
    speed: Floats,
    slot: Whole,
    tails: Whole,
    begin: int,
    limit: float,
    distances: NDArray[np.float32],
    speeds: NDArray[np.float32],
) -> None:
    """Fill the three distances and speeds of another approach whose first vehicle has the place `begin`: the
    end of the platoon that is crossing, and head and end of the first platoon that an AV leads."""
    if begin < 0:
        return
    head = begin
    row = order[begin]
    if slot[row] < 0:
        last = tails[row]
        distances[0] = _nearness(distance[last])
        speeds[0] = _quickness(speed[last], limit)
        while order[head] != last:
            head += 1
        head += 1
        if head >= len(order) or approach[order[head]] != approach[row]:
            return
        row = order[head]
    last = tails[row]
    distances[1] = _nearness(distance[row])
    distances[2] = _nearness(distance[last])
    speeds[1] = _quickness(speed[row], limit)
    speeds[2] = _quickness(speed[last], limit)


@compiled_apart
def observe(
    order: Whole,
    approach: Whole,
    distance: Floats,
    speed: Floats,
    slot: Whole,
    others: Whole,
    limit: float,
    tails: Whole,
    first: Whole,
    observations: NDArray[np.float32],
    alive: NDArray[np.bool_],
    state: NDArray[np.float32],
) -> None:
    """Fill observations (N, D), the alive mask (N,) and the state (3 G,) from V vehicles.

    `order` (V,): rows by approach, nearest first. `distance` (V,): distance to the end of the approach, below
    0 past the last one. `slot` (V,): -1 for vehicles that SUMO drives. `others` (G, K - 1): other approaches
    of each approach's junction. `limit`: speed limit, m/s. `tails` (V,) and `first` (G,) are scratch space.
    """
    size = observations.shape[1] // 2
    for place in range(len(alive)):
        if alive[place]:
            observations[place] = 0.0
            alive[place] = False
    _find_platoons(order, approach, distance, slot, tails, first)
    state[:] = 0.0
    for row in range(len(order)):
        own = approach[row]
        before = own >= 0 and distance[row] >= 0.0
        if before:
            state[3 * own + (0 if slot[row] >= 0 else 1)] += 0.1
            state[3 * own + 2] += speed[row]
        if slot[row] < 0:
            continue
        seen, last = observations[slot[row]], tails[row]
        alive[slot[row]] = True
        seen[0] = _nearness(distance[row]) if before else 1.0
        seen[1] = _nearness(distance[last]) if before else 1.0
        seen[size] = _quickness(speed[row], limit)
        seen[size + 1] = _quickness(speed[last], limit)
        for other in range((size - 2) // 3):
            place = 2 + 3 * other
            seen[place] = -1.0
            seen[place + 1 : place + 3] = 1.0
            seen[size + place] = 1.0
            seen[size + place + 1 : size + place + 3] = -1.0
            if before and other < others.shape[1] and others[own, other] >= 0:
                _observe_approach(
                    order, approach, distance, speed, slot, tails, first[others[own, other]], limit,
                    seen[place : place + 3], seen[size + place : size + place + 3],
                )  # fmt: skip
    for own in range(len(first)):
        vehicles = 10.0 * (state[3 * own] + state[3 * own + 1])
        state[3 * own + 2] /= max(vehicles, 1.0) * limit


def warm() -> None:
    """Compile every function, or load it from the cache, by an empty road."""
    rows, values = np.zeros(0, np.int64), np.zeros(0)
    observe(
        rows, rows, values, values, rows, np.zeros((1, 3), np.int64), 1.0, rows, np.zeros(1, np.int64),
        np.zeros((1, 22), np.float32), np.zeros(1, np.bool_), np.zeros(3, np.float32),
    )  # fmt: skip
