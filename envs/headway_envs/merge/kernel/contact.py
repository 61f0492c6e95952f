"""Contacts between vehicles and with obstacles.

Preset `clean`: outlines are tested by separating axes, at their positions and swept by one step's motion;
vehicles about to intersect are pushed apart at the next step and count as crashed then, as in highway-env
1.12.1. Preset `paper`: nine points of each vehicle are tested.
"""

import math

import numpy as np
from numpy.typing import NDArray

from headway_envs.merge.kernel.compiled import compiled, compiled_apart
from headway_envs.merge.kernel.layout import CAR_LENGTH, CAR_WIDTH, OBSTACLE_SIZE, STEP_S, Record

_CAR_DIAGONAL = math.sqrt(CAR_LENGTH * CAR_LENGTH + CAR_WIDTH * CAR_WIDTH)
_OBSTACLE_DIAGONAL = math.sqrt(2.0 * OBSTACLE_SIZE * OBSTACLE_SIZE)
_SHRUNK = 0.9


@compiled
def _interval_gap(low: float, high: float, other_low: float, other_high: float) -> float:
    return other_low - high if low < other_low else low - other_high


@compiled_apart
def outlines(
    a: Record, b: Record, b_length: float, b_width: float, moved_x: float, moved_y: float
) -> tuple[bool, bool, float, float]:
    """Return whether the outlines of vehicles a and b intersect now, whether they will after a has moved by
    (moved_x, moved_y) relative to b, and the shortest displacement (x, y) of a that separates them then."""
    meets, will_meet = True, True
    least, push_x, push_y = np.inf, 0.0, 0.0
    apart_x, apart_y = a.x - b.x, a.y - b.y
    for edge in range(8):
        cosine, sine = (a.cosine, a.sine) if edge < 4 else (b.cosine, b.sine)
        # Normals of the edges: back, right, front, left.
        if edge % 4 == 0:
            axis_x, axis_y = -cosine, -sine
        elif edge % 4 == 1:
            axis_x, axis_y = -sine, cosine
        elif edge % 4 == 2:
            axis_x, axis_y = cosine, sine
        else:
            axis_x, axis_y = sine, -cosine
        a_centre = a.x * axis_x + a.y * axis_y
        a_half = CAR_LENGTH / 2.0 * abs(a.cosine * axis_x + a.sine * axis_y)
        a_half += CAR_WIDTH / 2.0 * abs(a.cosine * axis_y - a.sine * axis_x)
        b_centre = b.x * axis_x + b.y * axis_y
        b_half = b_length / 2.0 * abs(b.cosine * axis_x + b.sine * axis_y)
        b_half += b_width / 2.0 * abs(b.cosine * axis_y - b.sine * axis_x)
        low, high = a_centre - a_half, a_centre + a_half
        if _interval_gap(low, high, b_centre - b_half, b_centre + b_half) > 0.0:
            meets = False
        moved = axis_x * moved_x + axis_y * moved_y
        # Extend the interval by the motion of the step.
        if moved < 0.0:
            low += moved
        else:
            high += moved
        gap = _interval_gap(low, high, b_centre - b_half, b_centre + b_half)
        if gap > 0.0:
            will_meet = False
        # Separating axes are known for both times, so the remaining ones need not be tested.
        if not meets and not will_meet:
            return False, False, 0.0, 0.0
        if abs(gap) < least:
            least = abs(gap)
            sign = 1.0 if apart_x * axis_x + apart_y * axis_y > 0.0 else -1.0
            push_x, push_y = sign * axis_x, sign * axis_y
    return meets, will_meet, least * push_x, least * push_y


@compiled
def _has_point_inside(
    a: Record, a_length: float, a_width: float, b: Record, b_length: float, b_width: float
) -> bool:
    """Return whether one of nine points of a, shrunk, lies in b, shrunk."""
    for along in (-1.0, 0.0, 1.0):
        for across in (-1.0, 0.0, 1.0):
            u, w = along * _SHRUNK * a_length / 2.0, across * _SHRUNK * a_width / 2.0
            x = a.x + a.cosine * u - a.sine * w - b.x
            y = a.y + a.sine * u + a.cosine * w - b.y
            inside = abs(b.cosine * x + b.sine * y) <= _SHRUNK * b_length / 2.0
            if inside and abs(b.cosine * y - b.sine * x) <= _SHRUNK * b_width / 2.0:
                return True
    return False


@compiled_apart
def shrunk_overlap(a: Record, b: Record, b_is_obstacle: bool) -> bool:
    """Return whether a and b overlap by the nine-point test, in both directions."""
    x, y = b.x - a.x, b.y - a.y
    if x * x + y * y > CAR_LENGTH * CAR_LENGTH:
        return False
    length, width = (OBSTACLE_SIZE, OBSTACLE_SIZE) if b_is_obstacle else (CAR_LENGTH, CAR_WIDTH)
    if _has_point_inside(a, CAR_LENGTH, CAR_WIDTH, b, length, width):
        return True
    return _has_point_inside(b, length, width, a, CAR_LENGTH, CAR_WIDTH)


@compiled_apart
def overlaps(k: Record, a: Record, b: Record, b_is_obstacle: bool) -> bool:
    """Return whether vehicle a overlaps b, by the test of the preset."""
    if not k.exact_outlines:
        return shrunk_overlap(a, b, b_is_obstacle)
    reach = _CAR_DIAGONAL / 2.0 + (_OBSTACLE_DIAGONAL if b_is_obstacle else _CAR_DIAGONAL) / 2.0
    x, y = b.x - a.x, b.y - a.y
    if x * x + y * y > reach * reach:
        return False
    if b_is_obstacle:
        return outlines(a, b, OBSTACLE_SIZE, OBSTACLE_SIZE, 0.0, 0.0)[0]
    return outlines(a, b, CAR_LENGTH, CAR_WIDTH, 0.0, 0.0)[0]


@compiled
def _collide_outlines(a: Record, b: Record, b_is_obstacle: bool) -> None:
    diagonal = _OBSTACLE_DIAGONAL if b_is_obstacle else _CAR_DIAGONAL
    reach = (_CAR_DIAGONAL + diagonal) / 2.0 + a.speed * STEP_S
    x, y = b.x - a.x, b.y - a.y
    # Vehicles this far apart cannot touch within the step.
    if abs(x) > reach or math.sqrt(x * x + y * y) > reach:
        return
    moved_x = (a.speed * a.cosine - b.speed * b.cosine) * STEP_S
    moved_y = (a.speed * a.sine - b.speed * b.sine) * STEP_S
    length, width = (OBSTACLE_SIZE, OBSTACLE_SIZE) if b_is_obstacle else (CAR_LENGTH, CAR_WIDTH)
    meets, will_meet, push_x, push_y = outlines(a, b, length, width, moved_x, moved_y)
    if will_meet:
        a.pushed = 1
        if b_is_obstacle:
            a.push_x, a.push_y = push_x, push_y
        else:
            a.push_x, a.push_y = push_x / 2.0, push_y / 2.0
            b.pushed = 1
            b.push_x, b.push_y = -push_x / 2.0, -push_y / 2.0
    if meets:
        a.crashed = 1
        b.crashed = 1


@compiled
def mark_collisions(k: Record, cars: NDArray[np.void], moving: int, bodies: int) -> None:
    """Mark crashed vehicles: the first `moving` of `bodies` are vehicles, the others obstacles."""
    if k.exact_outlines:
        for i in range(moving):
            for j in range(i + 1, bodies):
                _collide_outlines(cars[i], cars[j], j >= moving)
        return
    for i in range(moving):
        for j in range(bodies):
            if i == j or cars[i].crashed or not shrunk_overlap(cars[i], cars[j], j >= moving):
                continue
            slower = cars[i].speed if abs(cars[i].speed) <= abs(cars[j].speed) else cars[j].speed
            cars[i].speed = slower
            cars[j].speed = slower
            cars[i].crashed = 1
            cars[j].crashed = 1
