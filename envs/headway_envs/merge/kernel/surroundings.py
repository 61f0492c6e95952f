"""Who is next to a CAV."""

import numpy as np
from numpy.typing import NDArray

from headway_envs.merge.kernel.compiled import compiled, compiled_apart
from headway_envs.merge.kernel.layout import SIGHT, Network


@compiled_apart
def gap_ahead(net: Network, cars: NDArray[np.void], moving: int, me: int) -> float:
    """Distance along x, centre to centre and 60 m at most, to the next vehicle ahead that is on the same lane
    or, unless that ends, on the one that follows."""
    car = cars[me]
    lane = net.lanes[car.lane]
    follows = car.lane if lane.merging else lane.successor
    gap = SIGHT
    for other in range(moving):
        ahead = cars[other].x - car.x
        if 0.0 < ahead < gap and (cars[other].lane == car.lane or cars[other].lane == follows):
            gap = ahead
    return gap


@compiled_apart
def next_on(net: Network, cars: NDArray[np.void], moving: int, me: int, lane: int) -> tuple[int, int]:
    """The vehicles ahead and behind, by x, on a lane or those it leads from and to; -1: nobody."""
    ahead, behind = -1, -1
    gap_ahead, gap_behind = np.inf, np.inf
    if lane < 0:
        return ahead, behind
    for other in range(moving):
        if other == me or not net.near[lane, cars[other].lane]:
            continue
        gap = cars[other].x - cars[me].x
        if gap > 0.0:
            if gap < gap_ahead:
                ahead, gap_ahead = other, gap
        elif -gap < gap_behind:
            behind, gap_behind = other, -gap
    return ahead, behind


@compiled
def right_of(net: Network, cars: NDArray[np.void], me: int) -> int:
    """The right one of the two lanes whose vehicles are next to a vehicle; -1: there is none."""
    lane = net.lanes[cars[me].lane]
    return int(lane.right) if cars[me].x > lane.beside_from else -1
