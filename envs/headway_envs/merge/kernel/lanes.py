"""Where a vehicle is on a lane. Distances along a lane are along x, from its beginning."""

import math

import numpy as np
from numpy.typing import NDArray

from headway_envs.merge.kernel.compiled import compiled, compiled_apart
from headway_envs.merge.kernel.layout import CAR_LENGTH, LANE_WIDTH, Network, Record


@compiled
def not_zero(value: float) -> float:
    """`value`, or 0.01 with its sign where it is smaller."""
    if abs(value) > 1e-2:
        return value
    return 1e-2 if value >= 0.0 else -1e-2


@compiled
def wrapped(angle: float) -> float:
    """The same angle between -pi and pi."""
    if -math.pi <= angle < math.pi:
        return angle
    return (angle + math.pi) % (2.0 * math.pi) - math.pi


@compiled
def lateral(lane: Record, x: float, y: float) -> float:
    """Offset to the right of the lane's centre."""
    offset = y - lane.y
    if lane.amplitude != 0.0:
        offset -= lane.amplitude * math.sin(lane.pulsation * (x - lane.x) + lane.phase)
    return float(offset)


@compiled
def heading_at(lane: Record, along: float) -> float:
    """Heading of the lane's centre at a distance along it."""
    if lane.amplitude == 0.0:
        return 0.0
    return math.atan(lane.amplitude * lane.pulsation * math.cos(lane.pulsation * along + lane.phase))


@compiled
def after_end(lane: Record, x: float) -> bool:
    """Whether x is half a vehicle's length before the lane's end, or farther."""
    return bool(x - lane.x > lane.length - CAR_LENGTH / 2.0)


@compiled
def is_on(lane: Record, x: float, y: float) -> bool:
    """Whether a place counts as on the lane for those who look for vehicles there, with 1 m of margin."""
    along = x - lane.x
    if along < -CAR_LENGTH or along >= lane.length + CAR_LENGTH:
        return False
    return abs(lateral(lane, x, y)) <= LANE_WIDTH / 2.0 + 1.0


@compiled
def can_change_to(lane: Record, x: float, y: float) -> bool:
    """Whether a vehicle may change to the lane from here."""
    along = x - lane.x
    if lane.closed or along < 0.0 or along >= lane.length + CAR_LENGTH:
        return False
    return abs(lateral(lane, x, y)) <= 2.0 * LANE_WIDTH


@compiled_apart
def closest(lanes: NDArray[np.void], x: float, y: float, heading: float) -> int:
    """The lane that a vehicle is on: of the least sum of lateral offset, distance to its ends and angle."""
    least, found = np.inf, 0
    turned = abs(wrapped(heading))
    for index in range(lanes.shape[0]):
        lane = lanes[index]
        along = x - lane.x
        outside = max(along - lane.length, 0.0) + max(-along, 0.0)
        if outside >= least:
            continue
        angle = turned
        if lane.amplitude != 0.0:
            angle = abs(wrapped(heading - heading_at(lane, along)))
        distance = abs(lateral(lane, x, y)) + outside + angle
        if distance < least:
            least, found = distance, index
    return found


@compiled
def side_lane(net: Network, k: Record, lane: int, side: int) -> int:
    """The lane to the left (-1) or right (1) of one on the same road, or -1. With two ramp lanes nobody
    changes to the right: the inner one is open to those on the outer one only."""
    other = lane + side
    if other < net.lanes[lane].first or other > net.lanes[lane].last:
        return -1
    if side > 0 and k.ramp_lanes == 2:
        return -1
    return other
