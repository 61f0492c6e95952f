"""Positions relative to lanes. Distances along a lane are measured along x, from its start."""

import math

import numpy as np
from numpy.typing import NDArray

from headway_envs.merge.kernel.compiled import compiled, compiled_apart
from headway_envs.merge.kernel.layout import CAR_LENGTH, LANE_WIDTH, Network, Record


@compiled
def not_zero(value: float) -> float:
    """Return `value`, or 0.01 with its sign if its magnitude is at most 0.01."""
    if abs(value) > 1e-2:
        return value
    return 1e-2 if value >= 0.0 else -1e-2


@compiled
def wrapped(angle: float) -> float:
    """Return the equivalent angle in [-pi, pi)."""
    if -math.pi <= angle < math.pi:
        return angle
    return (angle + math.pi) % (2.0 * math.pi) - math.pi


@compiled
def lateral(lane: Record, x: float, y: float) -> float:
    """Return the offset to the right of the lane's centre, m."""
    offset = y - lane.y
    if lane.amplitude != 0.0:
        offset -= lane.amplitude * math.sin(lane.pulsation * (x - lane.x) + lane.phase)
    return float(offset)


@compiled
def heading_at(lane: Record, along: float) -> float:
    """Return the heading of the lane's centre at a distance along it, rad."""
    if lane.amplitude == 0.0:
        return 0.0
    return math.atan(lane.amplitude * lane.pulsation * math.cos(lane.pulsation * along + lane.phase))


@compiled
def past_end(lane: Record, x: float) -> bool:
    """Return whether x is less than half a vehicle's length before the lane's end, or past it."""
    return bool(x - lane.x > lane.length - CAR_LENGTH / 2.0)


@compiled
def is_on(lane: Record, x: float, y: float) -> bool:
    """Return whether a position counts as on the lane in the search for neighbours, with a margin of 1 m."""
    along = x - lane.x
    if along < -CAR_LENGTH or along >= lane.length + CAR_LENGTH:
        return False
    return abs(lateral(lane, x, y)) <= LANE_WIDTH / 2.0 + 1.0


@compiled
def can_change_to(lane: Record, x: float, y: float) -> bool:
    """Return whether a vehicle at (x, y) may change to the lane."""
    along = x - lane.x
    if lane.closed or along < 0.0 or along >= lane.length + CAR_LENGTH:
        return False
    return abs(lateral(lane, x, y)) <= 2.0 * LANE_WIDTH


@compiled_apart
def closest_lane(lanes: NDArray[np.void], x: float, y: float, heading: float) -> int:
    """Return the lane of a vehicle: the one with the least sum of lateral offset and distance beyond its
    ends, m, and angle, rad."""
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
    """Return the lane to the left (side -1) or right (side 1) on the same road; -1: none. With two ramp lanes
    there are no changes to the right: the inner one is open to vehicles on the outer one only."""
    other = lane + side
    if other < net.lanes[lane].first or other > net.lanes[lane].last:
        return -1
    if side > 0 and k.ramp_lanes == 2:
        return -1
    return other
