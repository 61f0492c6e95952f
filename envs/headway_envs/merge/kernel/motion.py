"""One simulation step of all vehicles of a copy."""

import math

import numpy as np
from numpy.typing import NDArray

from headway_envs.merge.kernel.compiled import compiled, compiled_apart
from headway_envs.merge.kernel.contact import collide
from headway_envs.merge.kernel.control import control
from headway_envs.merge.kernel.drivers import drive
from headway_envs.merge.kernel.lanes import closest
from headway_envs.merge.kernel.layout import CAR_LENGTH, Network, Record

_FASTEST = 40.0


@compiled
def roll(net: Network, car: Record, dt: float) -> None:
    """Move one vehicle by the kinematic bicycle model, all from the speed and heading at the step's begin."""
    if car.crashed:
        car.steering = 0.0
        car.acceleration = -car.speed
    if car.speed > _FASTEST:
        car.acceleration = min(car.acceleration, _FASTEST - car.speed)
    elif car.speed < -_FASTEST:
        car.acceleration = max(car.acceleration, -_FASTEST - car.speed)
    if car.steering == 0.0:
        car.x += car.speed * car.cosine * dt
        car.y += car.speed * car.sine * dt
    else:
        slip = math.atan(0.5 * math.tan(car.steering))
        car.x += car.speed * math.cos(car.heading + slip) * dt
        car.y += car.speed * math.sin(car.heading + slip) * dt
        car.heading += car.speed * math.sin(slip) / (CAR_LENGTH / 2.0) * dt
        car.cosine, car.sine = math.cos(car.heading), math.sin(car.heading)
    if car.pushed:
        car.x += car.push_x
        car.y += car.push_y
        car.pushed = 0
        car.crashed = 1
    car.speed += car.acceleration * dt
    car.lane = closest(net.lanes, car.x, car.y, car.heading)


@compiled_apart
def simulate(net: Network, k: Record, cars: NDArray[np.void], moving: int, things: int, dt: float) -> None:
    """Everybody decides in turn, then everybody moves, then contacts are looked for."""
    for i in range(moving):
        if cars[i].human:
            drive(net, k, cars, moving, things, i)
        else:
            control(net, k, cars[i])
    for i in range(moving):
        roll(net, cars[i], dt)
        cars[i].timer += dt
    collide(k, cars, moving, things)
