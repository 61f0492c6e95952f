"""Control of target lane and speed, and the effect of a CAV's actions on them.

Source: highway-env (Leurent 2018), whose controller is a cascade of proportional controllers.
"""

import math

import numpy as np
from numpy.typing import NDArray

from headway_envs.merge.kernel.compiled import compiled
from headway_envs.merge.kernel.lanes import (
    can_change_to,
    heading_at,
    lateral,
    not_zero,
    past_end,
    side_lane,
    wrapped,
)
from headway_envs.merge.kernel.layout import (
    CAR_LENGTH,
    FASTER,
    FASTEST_INDEX,
    IDLE,
    LEFT,
    MIN_TARGET_SPEED,
    RIGHT,
    SLOWER,
    SPEED_STEP,
    Network,
    Record,
)

_SPEED_GAIN, _HEADING_GAIN, _LATERAL_GAIN = 1.0 / 0.6, 1.0 / 0.2, 1.0 / 0.6
_LOOK_AHEAD_S = 0.1
_MAX_STEERING = math.pi / 3.0


@compiled
def _clip(value: float, low: float, high: float) -> float:
    return min(max(value, low), high)


@compiled
def speed_index(speed: float) -> int:
    """Return the index of the closest target speed; ties: the even index."""
    return int(_clip(np.rint((speed - MIN_TARGET_SPEED) / SPEED_STEP), 0.0, float(FASTEST_INDEX)))


@compiled
def steer(k: Record, lane: Record, car: Record) -> float:
    """Return the steering angle that keeps a vehicle at the centre of a lane, rad."""
    along, offset = car.x - lane.x, lateral(lane, car.x, car.y)
    if offset == 0.0 and car.heading == 0.0 and lane.amplitude == 0.0:
        return 0.0
    speed = not_zero(car.speed)
    turn = math.asin(_clip(-_LATERAL_GAIN * offset / speed, -1.0, 1.0))
    wanted = heading_at(lane, along + car.speed * _LOOK_AHEAD_S) + _clip(turn, -math.pi / 4.0, math.pi / 4.0)
    rate = _HEADING_GAIN * wrapped(wanted - car.heading)
    angle = math.asin(_clip(CAR_LENGTH / 2.0 / speed * rate, -1.0, 1.0))
    if k.steering_from_slip:
        angle = math.atan(2.0 * math.tan(angle))
    return _clip(angle, -_MAX_STEERING, _MAX_STEERING)


@compiled
def advance_target_lane(lanes: NDArray[np.void], car: Record) -> None:
    """Set the target lane to its successor at its end."""
    lane = lanes[car.target_lane]
    if past_end(lane, car.x):
        car.target_lane = lane.successor


@compiled
def _target_speed(car: Record, action: int) -> float:
    """Return the target speed of a CAV after `FASTER` or `SLOWER`."""
    index = speed_index(car.speed) + (1 if action == FASTER else -1)
    return float(MIN_TARGET_SPEED + SPEED_STEP * min(max(index, 0), FASTEST_INDEX))


@compiled
def closest_speed_action(car: Record, speed: float) -> int:
    """Return the action, `IDLE`, `FASTER` or `SLOWER`, whose target speed is closest to `speed`; ties: the
    first of them."""
    best, least = IDLE, abs(car.target_speed - speed)
    for action in (FASTER, SLOWER):
        distance = abs(_target_speed(car, action) - speed)
        if distance < least:
            best, least = action, distance
    return best


@compiled
def apply_action(net: Network, k: Record, car: Record, action: int) -> None:
    """Change the target lane or speed of a CAV by an action."""
    advance_target_lane(net.lanes, car)
    if action in (FASTER, SLOWER):
        car.target_speed = _target_speed(car, action)
    elif action in (LEFT, RIGHT):
        other = side_lane(net, k, car.target_lane, -1 if action == LEFT else 1)
        if other >= 0 and can_change_to(net.lanes[other], car.x, car.y):
            car.target_lane = other


@compiled
def control(net: Network, k: Record, car: Record) -> None:
    """Set the steering and acceleration of a CAV towards its targets."""
    advance_target_lane(net.lanes, car)
    car.steering = steer(k, net.lanes[car.target_lane], car)
    car.acceleration = _SPEED_GAIN * (car.target_speed - car.speed)
