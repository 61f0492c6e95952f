"""Human drivers: the intelligent driver model for the speed, MOBIL for changes of lane.

Sources: Treiber, Hennecke and Helbing 2000 (doi 10.1103/PhysRevE.62.1805); Kesting, Treiber and Helbing 2007
(doi 10.3141/1999-10); constants and what a driver sees as in highway-env 1.12.1.
"""

import math

import numpy as np
from numpy.typing import NDArray

from headway_envs.merge.kernel.compiled import compiled, compiled_apart
from headway_envs.merge.kernel.control import follow_road, steer
from headway_envs.merge.kernel.lanes import can_change_to, is_on, not_zero, side_lane
from headway_envs.merge.kernel.layout import Network, Record

_MOST_ACCELERATION, _COMFORT, _BRAKING = 6.0, 3.0, 5.0
_STANDING_GAP, _TIME_GAP_S = 10.0, 1.5
_THINK_EVERY_S = 1.0
_TWICE_ROOT = 2.0 * math.sqrt(_COMFORT * _BRAKING)


@compiled_apart
def neighbours(
    net: Network, cars: NDArray[np.void], things: int, me: int, lane_index: int
) -> tuple[int, int]:
    """Who is ahead of and behind a vehicle on a lane, of the first `things` vehicles and obstacles (-1:
    nobody).

    What stands farther than a vehicle's length beyond the lane's ends is not seen."""
    lane = net.lanes[lane_index]
    here = cars[me].x - lane.x
    ahead, behind = -1, -1
    gap_ahead, gap_behind = np.inf, -np.inf
    for other in range(things):
        if other == me or not is_on(lane, cars[other].x, cars[other].y):
            continue
        there = cars[other].x - lane.x
        if here <= there and there <= gap_ahead:
            ahead, gap_ahead = other, there
        if there < here and there > gap_behind:
            behind, gap_behind = other, there
    return ahead, behind


@compiled
def wanted_gap(ego: Record, ahead: Record) -> float:
    """Gap that the driver of `ego` wants to the vehicle ahead, centre to centre."""
    closing = (ego.speed * ego.cosine - ahead.speed * ahead.cosine) * ego.cosine
    closing += (ego.speed * ego.sine - ahead.speed * ahead.sine) * ego.sine
    return float(_STANDING_GAP + ego.speed * _TIME_GAP_S + ego.speed * closing / _TWICE_ROOT)


@compiled
def wanted_acceleration(cars: NDArray[np.void], moving: int, ego_index: int, ahead_index: int) -> float:
    """Acceleration that a driver wants behind another (-1: nobody); 0 for nobody (-1) and for obstacles,
    which begin at `moving`."""
    if ego_index < 0 or ego_index >= moving:
        return 0.0
    ego = cars[ego_index]
    share = max(ego.speed, 0.0) / abs(not_zero(ego.target_speed))
    acceleration = _COMFORT * (1.0 - share * share * share * share)
    if ahead_index >= 0:
        ahead = cars[ahead_index]
        pressure = wanted_gap(ego, ahead) / not_zero(ahead.x - ego.x)
        acceleration -= _COMFORT * pressure * pressure
    return float(acceleration)


@compiled
def _would_change(
    net: Network, k: Record, cars: NDArray[np.void], moving: int, things: int, me: int, lane: int
) -> bool:
    """MOBIL, without politeness."""
    new_ahead, new_behind = neighbours(net, cars, things, me, lane)
    if wanted_acceleration(cars, moving, new_behind, me) < -k.most_braking:
        return False
    ahead, _ = neighbours(net, cars, things, me, cars[me].lane)
    there = wanted_acceleration(cars, moving, me, new_ahead)
    here = wanted_acceleration(cars, moving, me, ahead)
    gain = there - here
    if k.ramp_lanes == 2 and there == here:
        gain += k.gain_where_equal
    return bool(gain >= k.least_gain)


@compiled
def _give_way(cars: NDArray[np.void], moving: int, me: int) -> None:
    """Give a change up if somebody not far ahead is already changing to the same lane."""
    car = cars[me]
    for index in range(moving):
        other = cars[index]
        if index == me or other.lane == car.target_lane or other.target_lane != car.target_lane:
            continue
        if 0.0 < other.x - car.x < wanted_gap(car, other):
            car.target_lane = car.lane
            return


@compiled
def _think_of_changing(
    net: Network, k: Record, cars: NDArray[np.void], moving: int, things: int, me: int
) -> None:
    car = cars[me]
    if car.lane != car.target_lane:
        if net.lanes[car.lane].first == net.lanes[car.target_lane].first:
            _give_way(cars, moving, me)
        return
    if car.timer <= _THINK_EVERY_S:
        return
    car.timer = 0.0
    for side in (-1, 1):
        lane = side_lane(net, k, car.lane, side)
        if lane < 0 or not can_change_to(net.lanes[lane], car.x, car.y):
            continue
        if abs(car.speed) >= k.least_change_speed and _would_change(net, k, cars, moving, things, me, lane):
            car.target_lane = lane


@compiled
def keep_on(
    net: Network, k: Record, cars: NDArray[np.void], moving: int, things: int, me: int, as_if: Record
) -> None:
    """Steering and acceleration of a human driver that keeps the target lane, written to `as_if`."""
    car = cars[me]
    steering = steer(k, net.lanes[car.target_lane], car)
    ahead, _ = neighbours(net, cars, things, me, car.lane)
    acceleration = wanted_acceleration(cars, moving, me, ahead)
    if k.follow_both_lanes and car.lane != car.target_lane:
        ahead, _ = neighbours(net, cars, things, me, car.target_lane)
        acceleration = min(acceleration, wanted_acceleration(cars, moving, me, ahead))
    as_if.steering = steering
    as_if.acceleration = min(max(acceleration, -_MOST_ACCELERATION), _MOST_ACCELERATION)


@compiled_apart
def drive(net: Network, k: Record, cars: NDArray[np.void], moving: int, things: int, me: int) -> None:
    """What a human driver does in one simulation step."""
    if cars[me].crashed:
        return
    follow_road(net.lanes, cars[me])
    _think_of_changing(net, k, cars, moving, things, me)
    keep_on(net, k, cars, moving, things, me, cars[me])
