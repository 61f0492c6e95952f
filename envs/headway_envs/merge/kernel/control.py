"""How a vehicle keeps to its target lane and speed, and what the actions of a CAV change.

Source: highway-env (Leurent 2018), whose controller is a cascade of proportional ones.
"""

import math

import numpy as np
from numpy.typing import NDArray

from headway_envs.merge.kernel.compiled import compiled
from headway_envs.merge.kernel.lanes import (
    after_end,
    can_change_to,
    heading_at,
    lateral,
    not_zero,
    side_lane,
    wrapped,
)
from headway_envs.merge.kernel.layout import (
    CAR_LENGTH,
    FASTER,
    FASTEST_INDEX,
    LEFT,
    RIGHT,
    SLOWER,
    SLOWEST,
    SPEED_STEP,
    Network,
    Record,
)

_SPEED_GAIN, _HEADING_GAIN, _LATERAL_GAIN = 1.0 / 0.6, 1.0 / 0.2, 1.0 / 0.6
_LOOK_AHEAD_S = 0.1
_MOST_STEERING = math.pi / 3.0


@compiled
def _clip(value: float, low: float, high: float) -> float:
    return min(max(value, low), high)


@compiled
def speed_index(speed: float) -> int:
    """Index of the target speed that is closest; of two equally close, the even one."""
    return int(_clip(np.rint((speed - SLOWEST) / SPEED_STEP), 0.0, float(FASTEST_INDEX)))


@compiled
def steer(k: Record, lane: Record, car: Record) -> float:
    """Steering angle to keep to the centre of a lane."""
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
    return _clip(angle, -_MOST_STEERING, _MOST_STEERING)


@compiled
def follow_road(lanes: NDArray[np.void], car: Record) -> None:
    """At the end of the target lane, go on to the next."""
    lane = lanes[car.target_lane]
    if after_end(lane, car.x):
        car.target_lane = lane.successor


@compiled
def decide(net: Network, k: Record, car: Record, action: int) -> None:
    """Change the targets of a CAV by an action."""
    follow_road(net.lanes, car)
    if action in (FASTER, SLOWER):
        index = speed_index(car.speed) + (1 if action == FASTER else -1)
        car.target_speed = SLOWEST + SPEED_STEP * min(max(index, 0), FASTEST_INDEX)
    elif action in (LEFT, RIGHT):
        other = side_lane(net, k, car.target_lane, -1 if action == LEFT else 1)
        if other >= 0 and can_change_to(net.lanes[other], car.x, car.y):
            car.target_lane = other


@compiled
def control(net: Network, k: Record, car: Record) -> None:
    """Steering and acceleration of a CAV towards its targets."""
    follow_road(net.lanes, car)
    car.steering = steer(k, net.lanes[car.target_lane], car)
    car.acceleration = _SPEED_GAIN * (car.target_speed - car.speed)
