"""Vehicles next to a CAV."""

import numpy as np
from numpy.typing import NDArray

from headway_envs.merge.kernel.compiled import compiled, compiled_apart
from headway_envs.merge.kernel.layout import MAX_GAP, Network


@compiled_apart
def gap_ahead(net: Network, cars: NDArray[np.void], moving: int, ego: int) -> float:
    """Return the distance along x, centre to centre and at most 60 m, to the next vehicle ahead on the same
    lane or, unless that lane ends, on its successor."""
    car = cars[ego]
    lane = net.lanes[car.lane]
    follows = car.lane if lane.merging else lane.successor
    gap = MAX_GAP
    for other in range(moving):
        ahead = cars[other].x - car.x
        if 0.0 < ahead < gap and (cars[other].lane == car.lane or cars[other].lane == follows):
            gap = ahead
    return gap


@compiled_apart
def adjacent_vehicles(
    net: Network, cars: NDArray[np.void], moving: int, ego: int, lane: int
) -> tuple[int, int]:
    """Return the nearest vehicles ahead and behind, by x, on `lane` or lanes connected to it; -1: none."""
    ahead, behind = -1, -1
    gap_ahead, gap_behind = np.inf, np.inf
    if lane < 0:
        return ahead, behind
    for other in range(moving):
        if other == ego or not net.near[lane, cars[other].lane]:
            continue
        gap = cars[other].x - cars[ego].x
        if gap > 0.0:
            if gap < gap_ahead:
                ahead, gap_ahead = other, gap
        elif -gap < gap_behind:
            behind, gap_behind = other, -gap
    return ahead, behind


@compiled
def right_neighbour_lane(net: Network, cars: NDArray[np.void], ego: int) -> int:
    """Return the lane to the right of a CAV, if it runs beside its own lane at this position; -1: none."""
    lane = net.lanes[cars[ego].lane]
    return int(lane.right) if cars[ego].x > lane.beside_from else -1
