"""Observations, action masks and states."""

import math

import numpy as np
from numpy.typing import NDArray

from headway_envs.merge.kernel.compiled import compiled
from headway_envs.merge.kernel.lanes import can_change_to, side_lane
from headway_envs.merge.kernel.layout import (
    CAR_STATE,
    FASTER,
    FASTEST_INDEX,
    IDLE,
    LEFT,
    MIN_TARGET_SPEED,
    OBSERVED_VEHICLES,
    RIGHT,
    SLOWER,
    SPEED_STEP,
    Network,
    Outputs,
    Record,
    World,
)

_X, _Y, _SPEED = 150.0, 12.0, 45.0
"""Divisors of x, y and speeds in observations, m and m/s."""
_OBSERVED_WITHIN_M = 180.0


@compiled
def _observe_one(cars: NDArray[np.void], moving: int, ego: int, row: NDArray[np.float32]) -> None:
    """Fill a CAV's observation: 1, x, y and velocity of the CAV, then of the `OBSERVED_VEHICLES` closest
    vehicles along the road within 180 m, relative to the CAV; zeros if there are fewer."""
    car = cars[ego]
    vx, vy = car.speed * car.cosine, car.speed * car.sine
    row[:] = 0.0
    row[0] = 1.0
    row[1], row[2], row[3], row[4] = car.x / _X, car.y / _Y, vx / _SPEED, vy / _SPEED
    last_gap, last = -1.0, -1
    for place in range(1, OBSERVED_VEHICLES + 1):
        # Select the next vehicle in order of distance, ties by index.
        least, found = np.inf, -1
        for other in range(moving):
            dx, dy = cars[other].x - car.x, cars[other].y - car.y
            gap = abs(dx)
            if other == ego or gap > least or (gap == least and found >= 0):
                continue
            if gap < last_gap or (gap == last_gap and other <= last):
                continue
            if math.sqrt(dx * dx + dy * dy) < _OBSERVED_WITHIN_M:
                least, found = gap, other
        if found < 0:
            return
        other = cars[found]
        at = 5 * place
        row[at] = 1.0
        row[at + 1], row[at + 2] = (other.x - car.x) / _X, (other.y - car.y) / _Y
        row[at + 3] = (other.speed * other.cosine - vx) / _SPEED
        row[at + 4] = (other.speed * other.sine - vy) / _SPEED
        last_gap, last = least, found


@compiled
def fill_action_mask(net: Network, k: Record, car: Record, allowed: NDArray[np.bool_]) -> None:
    """Fill the action mask of a CAV: changes to lanes open from here, and target speeds that exist."""
    left, right = side_lane(net, k, car.lane, -1), side_lane(net, k, car.lane, 1)
    allowed[IDLE] = True
    allowed[LEFT] = left >= 0 and can_change_to(net.lanes[left], car.x, car.y)
    allowed[RIGHT] = right >= 0 and can_change_to(net.lanes[right], car.x, car.y)
    allowed[FASTER] = car.target_speed < MIN_TARGET_SPEED + SPEED_STEP * FASTEST_INDEX
    allowed[SLOWER] = car.target_speed > MIN_TARGET_SPEED


@compiled
def observe(net: Network, k: Record, world: World, outputs: Outputs, c: int) -> None:
    """Fill observations, alive mask, action masks and state of copy c."""
    episode, cars = world.episodes[c], world.cars[c]
    slots = outputs.alive.shape[1]
    for n in range(slots):
        outputs.alive[c, n] = n < episode.cavs
        if n < episode.cavs:
            _observe_one(cars, episode.cars, n, outputs.observations[c, n])
            fill_action_mask(net, k, cars[n], outputs.masks[c, n])
        else:
            outputs.observations[c, n] = 0.0
            outputs.masks[c, n] = True
    state = outputs.states[c]
    state[:] = 0.0
    for i in range(episode.cars):
        car = cars[i]
        at = CAR_STATE * (i if i < episode.cavs else slots + i - episode.cavs)
        state[at] = 1.0
        state[at + 1], state[at + 2] = car.x / _X, car.y / _Y
        state[at + 3] = car.speed * car.cosine / _SPEED
        state[at + 4] = car.speed * car.sine / _SPEED
        state[at + 5] = car.target_speed / _SPEED
        state[at + 6] = 0.5 * (car.target_lane - net.lanes[car.target_lane].first)
    state[state.shape[0] - 1] = episode.step / k.steps
