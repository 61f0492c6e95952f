"""Human drivers: the Intelligent Driver Model (IDM) for the speed, MOBIL for lane changes.

Sources: Treiber, Hennecke and Helbing 2000 (doi 10.1103/PhysRevE.62.1805); Kesting, Treiber and Helbing 2007
(doi 10.3141/1999-10). Constants and the search for neighbours follow highway-env 1.12.1.
"""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from headway_envs.merge.kernel.compiled import compiled, compiled_apart
from headway_envs.merge.kernel.control import advance_target_lane, closest_speed_action, steer
from headway_envs.merge.kernel.lanes import can_change_to, is_on, not_zero, side_lane
from headway_envs.merge.kernel.layout import LEFT, RIGHT, Network, Record, World

_MAX_ACCELERATION, _COMFORT, _BRAKING = 6.0, 3.0, 5.0
_STANDING_GAP, _TIME_GAP_S = 10.0, 1.5
_LANE_CHANGE_INTERVAL_S = 1.0
_TWICE_ROOT = 2.0 * math.sqrt(_COMFORT * _BRAKING)


@compiled_apart
def neighbours(
    net: Network, cars: NDArray[np.void], bodies: int, ego: int, lane_index: int
) -> tuple[int, int]:
    """Return the indices of the vehicles or obstacles ahead of and behind a vehicle on a lane (-1: none).

    Only the first `bodies` records are searched, up to a vehicle's length beyond the lane's ends."""
    lane = net.lanes[lane_index]
    here = cars[ego].x - lane.x
    ahead, behind = -1, -1
    gap_ahead, gap_behind = np.inf, -np.inf
    for other in range(bodies):
        if other == ego or not is_on(lane, cars[other].x, cars[other].y):
            continue
        there = cars[other].x - lane.x
        if here <= there and there <= gap_ahead:
            ahead, gap_ahead = other, there
        if there < here and there > gap_behind:
            behind, gap_behind = other, there
    return ahead, behind


@compiled
def desired_gap(ego: Record, ahead: Record) -> float:
    """Return the desired gap of `ego` to the vehicle ahead, centre to centre, m."""
    closing = (ego.speed * ego.cosine - ahead.speed * ahead.cosine) * ego.cosine
    closing += (ego.speed * ego.sine - ahead.speed * ahead.sine) * ego.sine
    return float(_STANDING_GAP + ego.speed * _TIME_GAP_S + ego.speed * closing / _TWICE_ROOT)


@compiled
def desired_acceleration(cars: NDArray[np.void], moving: int, ego_index: int, ahead_index: int) -> float:
    """Return the IDM acceleration of a driver behind `ahead_index` (-1: free road), m/s2. It is 0 if
    `ego_index` is -1 (no vehicle) or an obstacle (`moving` or above)."""
    if ego_index < 0 or ego_index >= moving:
        return 0.0
    ego = cars[ego_index]
    share = max(ego.speed, 0.0) / abs(not_zero(ego.target_speed))
    acceleration = _COMFORT * (1.0 - share * share * share * share)
    if ahead_index >= 0:
        ahead = cars[ahead_index]
        pressure = desired_gap(ego, ahead) / not_zero(ahead.x - ego.x)
        acceleration -= _COMFORT * pressure * pressure
    return float(acceleration)


@compiled
def _accepts_change(
    net: Network, k: Record, cars: NDArray[np.void], moving: int, bodies: int, ego: int, lane: int
) -> bool:
    """Return whether MOBIL, with politeness 0, accepts a change to `lane`."""
    new_ahead, new_behind = neighbours(net, cars, bodies, ego, lane)
    # MOBIL's safety criterion: the new follower must not have to brake harder.
    if desired_acceleration(cars, moving, new_behind, ego) < -k.max_braking:
        return False
    ahead, _ = neighbours(net, cars, bodies, ego, cars[ego].lane)
    there = desired_acceleration(cars, moving, ego, new_ahead)
    here = desired_acceleration(cars, moving, ego, ahead)
    gain = there - here
    if k.ramp_lanes == 2 and there == here:
        gain += k.tie_gain
    return bool(gain >= k.min_gain)


@compiled
def _accepted_lane(
    net: Network, k: Record, cars: NDArray[np.void], moving: int, bodies: int, ego: int
) -> int:
    """Return the lane beside its own to which a human driver would change; -1: none."""
    car, found = cars[ego], -1
    for side in (-1, 1):
        lane = side_lane(net, k, car.lane, side)
        if lane < 0 or not can_change_to(net.lanes[lane], car.x, car.y):
            continue
        if abs(car.speed) >= k.min_change_speed and _accepts_change(net, k, cars, moving, bodies, ego, lane):
            found = lane
    return found


@compiled
def _cancel_conflicting_change(cars: NDArray[np.void], moving: int, ego: int) -> None:
    """Cancel a lane change if a vehicle closely ahead is already changing to the same lane."""
    car = cars[ego]
    for index in range(moving):
        other = cars[index]
        if index == ego or other.lane == car.target_lane or other.target_lane != car.target_lane:
            continue
        if 0.0 < other.x - car.x < desired_gap(car, other):
            car.target_lane = car.lane
            return


@compiled
def _consider_lane_change(
    net: Network, k: Record, cars: NDArray[np.void], moving: int, bodies: int, ego: int
) -> None:
    """Cancel an ongoing lane change or, once per second, consider a new one."""
    car = cars[ego]
    if car.lane != car.target_lane:
        if net.lanes[car.lane].first == net.lanes[car.target_lane].first:
            _cancel_conflicting_change(cars, moving, ego)
        return
    if car.timer <= _LANE_CHANGE_INTERVAL_S:
        return
    car.timer = 0.0
    lane = _accepted_lane(net, k, cars, moving, bodies, ego)
    if lane >= 0:
        car.target_lane = lane


@compiled
def _following_acceleration(
    net: Network, k: Record, cars: NDArray[np.void], moving: int, bodies: int, ego: int
) -> float:
    """Return the acceleration of a human driver behind the vehicles ahead, m/s2."""
    car = cars[ego]
    ahead, _ = neighbours(net, cars, bodies, ego, car.lane)
    acceleration = desired_acceleration(cars, moving, ego, ahead)
    if k.follow_both_lanes and car.lane != car.target_lane:
        ahead, _ = neighbours(net, cars, bodies, ego, car.target_lane)
        acceleration = min(acceleration, desired_acceleration(cars, moving, ego, ahead))
    return float(min(max(acceleration, -_MAX_ACCELERATION), _MAX_ACCELERATION))


@compiled
def follow_target_lane(
    net: Network, k: Record, cars: NDArray[np.void], moving: int, bodies: int, ego: int, controlled: Record
) -> None:
    """Write the steering and acceleration of a human driver that follows its target lane to `controlled`."""
    steering = steer(k, net.lanes[cars[ego].target_lane], cars[ego])
    acceleration = _following_acceleration(net, k, cars, moving, bodies, ego)
    controlled.steering = steering
    controlled.acceleration = acceleration


@compiled_apart
def drive_human(net: Network, k: Record, cars: NDArray[np.void], moving: int, bodies: int, ego: int) -> None:
    """Apply a human driver's decisions for one simulation step."""
    if cars[ego].crashed:
        return
    advance_target_lane(net.lanes, cars[ego])
    _consider_lane_change(net, k, cars, moving, bodies, ego)
    follow_target_lane(net, k, cars, moving, bodies, ego, cars[ego])


@compiled_apart
def write_human_actions(
    net: Network, settings: NDArray[Any], world: World, actions: NDArray[np.int64]
) -> None:
    """Write the action of each CAV that is closest to what a human driver would do to `actions` (C, N).

    It is the change of lane that MOBIL accepts, without the human drivers' pause between two changes;
    otherwise the one with the target speed closest to IDM's one second ahead.
    """
    k = settings[0]
    for c in range(actions.shape[0]):
        cars, moving = world.cars[c], world.episodes[c].cars
        bodies = moving + net.obstacles.shape[0]
        for n in range(world.episodes[c].cavs):
            car = cars[n]
            target_speed = car.target_speed
            car.target_speed = car.desired_speed  # as IDM and MOBIL read it
            lane = _accepted_lane(net, k, cars, moving, bodies, n) if car.lane == car.target_lane else -1
            acceleration = _following_acceleration(net, k, cars, moving, bodies, n)
            car.target_speed = target_speed
            if lane >= 0:
                actions[c, n] = LEFT if lane < car.lane else RIGHT
            else:
                actions[c, n] = closest_speed_action(car, car.speed + acceleration)
