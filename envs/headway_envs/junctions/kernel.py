"""Compiled kernel: the state, from all vehicles' approaches, distances and speeds.

Axes: V vehicles, G approaches.
"""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from headway_envs.numba_setup import compiled_apart, drop_stale_cache

Floats = NDArray[np.float64]
Whole = NDArray[np.int64]

drop_stale_cache(Path(__file__).parent)

STATE_PER_APPROACH = 3
"""Numbers of AVs and of human drivers, mean speed."""


@compiled_apart
def fill_state(
    approach: Whole, distance: Floats, speed: Floats, slot: Whole, limit: float, state: NDArray[np.float32]
) -> None:
    """Fill the state (3 G,) from V vehicles.

    `distance` (V,): distance to the end of the approach, below 0 past the last one. `slot` (V,): -1 for
    vehicles that SUMO drives. `limit`: speed limit, m/s.
    """
    state[:] = 0.0
    for row in range(len(approach)):
        own = approach[row]
        if own >= 0 and distance[row] >= 0.0:
            state[3 * own + (0 if slot[row] >= 0 else 1)] += 0.1
            state[3 * own + 2] += speed[row]
    for own in range(len(state) // 3):
        vehicles = 10.0 * (state[3 * own] + state[3 * own + 1])
        state[3 * own + 2] /= max(vehicles, 1.0) * limit


def warm() -> None:
    """Compile every function, or load it from the cache, by an empty road."""
    rows, values = np.zeros(0, np.int64), np.zeros(0)
    fill_state(rows, values, values, rows, 1.0, np.zeros(3, np.float32))
