"""Observation of platoons at junctions: its features, and a compiled kernel that fills it from all vehicles'
approaches, distances and speeds. Source: Yan and Wu (2021, arXiv:2111.04686).

Axes: V vehicles, G approaches, K approaches of a junction, N slots, D = 2 (2 + 3 (K - 1)).
"""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from headway.contracts import ObservationFeature
from headway_envs.numba_setup import compiled, compiled_apart, drop_stale_cache

Floats = NDArray[np.float64]
Whole = NDArray[np.int64]

drop_stale_cache(Path(__file__).parent)

_SHOWN = (
    ("crossing_end", "last of the platoon whose head has passed", ("0 m", "the limit")),
    ("head", "first AV that has not passed", ("{sight:.0f} m", "0 m/s")),
    ("end", "last of the platoon of the first AV that has not passed", ("{sight:.0f} m", "0 m/s")),
)
"""Vehicles of another approach: name, meaning, and distance and speed shown where there is none."""


def features(approaches: int, sight: float, limit: float) -> tuple[ObservationFeature, ...]:
    """Return the features of an observation with K = `approaches`: all distances, then all speeds. `sight`:
    distance to the end of an approach at which observed distances are clipped, m; `limit`: speed limit, m/s.
    """
    shown = [("own", "the AV itself", ("", "")), ("platoon_end", "last of its platoon", ("", ""))]
    for number in range(1, approaches):
        for name, meaning, none in _SHOWN:
            shown.append((f"approach_{number}_{name}", f"approach {number} clockwise, {meaning}", none))
    quantities = (
        (
            "distance",
            f"distance to the junction, 0 to {sight:.0f} m, minus {sight / 2:.0f} m",
            "m",
            sight,
        ),
        ("speed", "speed, 0 to the limit, minus half the limit", "m/s", limit),
    )
    return tuple(
        ObservationFeature(
            f"{name}_{quantity}",
            f"{meaning}: {what}"
            + (f"; none: as at {none[place].format(sight=sight)}" if none[place] else ""),
            unit,
            scale / 2,
        )
        for place, (quantity, what, unit, scale) in enumerate(quantities)
        for name, meaning, none in shown
    )


@compiled
def _scaled(value: float, most: float) -> float:
    """Return a distance or a speed between 0 and `most` scaled to [-1, 1]."""
    return 2.0 * min(max(value / most, 0.0), 1.0) - 1.0


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
    sight: float,
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
        distances[0] = _scaled(distance[last], sight)
        speeds[0] = _scaled(speed[last], limit)
        while order[head] != last:
            head += 1
        head += 1
        if head >= len(order) or approach[order[head]] != approach[row]:
            return
        row = order[head]
    last = tails[row]
    distances[1] = _scaled(distance[row], sight)
    distances[2] = _scaled(distance[last], sight)
    speeds[1] = _scaled(speed[row], limit)
    speeds[2] = _scaled(speed[last], limit)


@compiled_apart
def observe(
    order: Whole,
    approach: Whole,
    distance: Floats,
    speed: Floats,
    slot: Whole,
    others: Whole,
    sight: float,
    limit: float,
    size: int,
    tails: Whole,
    first: Whole,
    observations: NDArray[np.float32],
    alive: NDArray[np.bool_],
) -> None:
    """Fill the first D = 2 `size` numbers of the observations (N, at least D), and the alive mask (N,), from
    V vehicles.

    `order` (V,): rows by approach, nearest first. `distance` (V,): distance to the end of the approach, below
    0 past the last one. `slot` (V,): -1 for vehicles that SUMO drives. `others` (G, K - 1): other approaches
    of each approach's junction. `sight`, `limit`: as in `features`. `tails` (V,) and `first` (G,) are scratch
    space.
    """
    for place in range(len(alive)):
        if alive[place]:
            observations[place] = 0.0
            alive[place] = False
    _find_platoons(order, approach, distance, slot, tails, first)
    for row in range(len(order)):
        if slot[row] < 0:
            continue
        own = approach[row]
        before = own >= 0 and distance[row] >= 0.0
        seen, last = observations[slot[row]], tails[row]
        alive[slot[row]] = True
        seen[0] = _scaled(distance[row], sight) if before else 1.0
        seen[1] = _scaled(distance[last], sight) if before else 1.0
        seen[size] = _scaled(speed[row], limit)
        seen[size + 1] = _scaled(speed[last], limit)
        for other in range((size - 2) // 3):
            place = 2 + 3 * other
            seen[place] = -1.0
            seen[place + 1 : place + 3] = 1.0
            seen[size + place] = 1.0
            seen[size + place + 1 : size + place + 3] = -1.0
            if before and other < others.shape[1] and others[own, other] >= 0:
                _observe_approach(
                    order, approach, distance, speed, slot, tails, first[others[own, other]], sight,
                    limit, seen[place : place + 3], seen[size + place : size + place + 3],
                )  # fmt: skip


def warm() -> None:
    """Compile every function, or load it from the cache, by an empty road."""
    rows, values = np.zeros(0, np.int64), np.zeros(0)
    observe(
        rows, rows, values, values, rows, np.zeros((1, 3), np.int64), 1.0, 1.0, 11, rows,
        np.zeros(1, np.int64), np.zeros((1, 22), np.float32), np.zeros(1, np.bool_),
    )  # fmt: skip
