"""One simulation step of all vehicles of a copy."""

import math

import numpy as np
from numpy.typing import NDArray

from headway_envs.merge.kernel.compiled import compiled, compiled_apart
from headway_envs.merge.kernel.contact import mark_collisions
from headway_envs.merge.kernel.control import control
from headway_envs.merge.kernel.drivers import drive_human
from headway_envs.merge.kernel.lanes import closest_lane
from headway_envs.merge.kernel.layout import CAR_LENGTH, Network, Record

_MAX_SPEED = 40.0


@compiled
def move(net: Network, car: Record, dt: float) -> None:
    """Move one vehicle by the kinematic bicycle model, with speed and heading of the step's start."""
    if car.crashed:
        car.steering = 0.0
        # A crashed vehicle slows down with a time constant of one second.
        car.acceleration = -car.speed
    if car.speed > _MAX_SPEED:
        car.acceleration = min(car.acceleration, _MAX_SPEED - car.speed)
    elif car.speed < -_MAX_SPEED:
        car.acceleration = max(car.acceleration, -_MAX_SPEED - car.speed)
    if car.steering == 0.0:
        car.x += car.speed * car.cosine * dt
        car.y += car.speed * car.sine * dt
    else:
        # The centre of mass lies midway between the axles.
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
    car.lane = closest_lane(net.lanes, car.x, car.y, car.heading)


@compiled_apart
def simulate(net: Network, k: Record, cars: NDArray[np.void], moving: int, bodies: int, dt: float) -> None:
    """Simulate one step: all vehicles decide in turn, then all move, then contacts are detected."""
    for i in range(moving):
        if cars[i].human:
            drive_human(net, k, cars, moving, bodies, i)
        else:
            control(net, k, cars[i])
    for i in range(moving):
        move(net, cars[i], dt)
        cars[i].timer += dt
    mark_collisions(k, cars, moving, bodies)
