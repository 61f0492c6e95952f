"""Initial positions and speeds of an episode's vehicles."""

import numpy as np

from headway_envs.keyed_random import episode_key, uniform
from headway_envs.merge.kernel.compiled import compiled, compiled_apart
from headway_envs.merge.kernel.control import speed_index
from headway_envs.merge.kernel.lanes import closest_lane
from headway_envs.merge.kernel.layout import MIN_TARGET_SPEED, SPEED_STEP, Network, Record, World

NUMBER, PLACE, RAMP, SPEED, OFFSET, PRIORITY, PREDICTION_NOISE = 1, 2, 3, 4, 5, 6, 7
"""Purposes of draws; the last two belong to the supervisor."""

PLACES, PLACES_APART = 6, 40.0
HIGHWAY_START, RAMP_START = 10.0, 5.0
"""x of the first starting place, m; there are six on the highway and six along the ramp, 40 m apart."""


@compiled
def _draw_count(key: np.uint64, index: int, low: int, high: int) -> int:
    """Draw an integer between `low` and `high`, both included."""
    return low + int(uniform(key, NUMBER, index, 0) * (high - low + 1))


@compiled
def _draw_place(key: np.uint64, index: int, taken: int) -> int:
    """Draw a free place; bit i of `taken` is set if place i is taken."""
    left = 0
    for place in range(PLACES):
        left += 1 - ((taken >> place) & 1)
    rank = int(uniform(key, PLACE, index, 0) * left)
    for place in range(PLACES):
        if not (taken >> place) & 1:
            if rank == 0:
                return place
            rank -= 1
    return 0


@compiled
def _place_vehicle(net: Network, key: np.uint64, car: Record, index: int, lane_index: int, x: float) -> None:
    """Put a vehicle on a lane within 1.5 m of x, at a speed of 25 to 27 m/s."""
    lane = net.lanes[lane_index]
    car.x = x + 3.0 * uniform(key, OFFSET, index, 0) - 1.5
    car.y = lane.y
    car.heading = 0.0
    car.cosine, car.sine = 1.0, 0.0
    car.speed = 25.0 + 2.0 * uniform(key, SPEED, index, 0)
    car.desired_speed = car.speed
    car.timer = (car.x + car.y) * np.pi % 1.0
    car.steering = 0.0
    car.acceleration = 0.0
    car.pushed = 0
    car.crashed = 0
    car.merged = 0
    car.lane = closest_lane(net.lanes, car.x, car.y, car.heading)
    car.target_lane = car.lane


@compiled_apart
def begin_episode(net: Network, k: Record, world: World, c: int, seed: np.uint64, number: int) -> None:
    """Reset copy c to the start of an episode.

    Half of the CAVs and half of the HDVs, both rounded down, start on the highway, the others on the ramp; if
    there are two ramp lanes, on either with equal probability."""
    episode, cars = world.episodes[c], world.cars[c]
    key = episode_key(seed, number)
    episode.seed, episode.key, episode.number, episode.step = seed, key, number, 0
    episode.cavs = _draw_count(key, 0, k.min_cavs, k.max_cavs)
    hdvs = _draw_count(key, 1, k.min_hdvs, k.max_hdvs)
    episode.cars = episode.cavs + hdvs
    episode.crash = episode.interventions = 0
    episode.reward = episode.speed = 0.0
    episode.min_speed = episode.min_gap = episode.min_headway = np.inf
    highway, ramp = 0, 0
    for i in range(episode.cars):
        is_cav = i < episode.cavs
        rank, group = (i, episode.cavs) if is_cav else (i - episode.cavs, hdvs)
        car = cars[i]
        car.from_ramp = 0 if rank < group // 2 else 1
        if car.from_ramp:
            place = _draw_place(key, i, ramp)
            ramp |= 1 << place
            outer = k.ramp_lanes == 2 and uniform(key, RAMP, i, 0) < 0.5
            _place_vehicle(net, key, car, i, net.spawn[2 if outer else 1], RAMP_START + PLACES_APART * place)
        else:
            place = _draw_place(key, i, highway)
            highway |= 1 << place
            _place_vehicle(net, key, car, i, net.spawn[0], HIGHWAY_START + PLACES_APART * place)
        car.human = 0 if is_cav else 1
        car.target_speed = (
            MIN_TARGET_SPEED + SPEED_STEP * speed_index(car.speed) if is_cav else car.desired_speed
        )
    for o in range(net.obstacles.shape[0]):
        obstacle = cars[episode.cars + o]
        obstacle.x, obstacle.y = net.obstacles[o, 0], net.obstacles[o, 1]
        obstacle.heading = obstacle.sine = obstacle.speed = 0.0
        obstacle.cosine = 1.0
        obstacle.lane = closest_lane(net.lanes, obstacle.x, obstacle.y, 0.0)
        obstacle.target_lane = obstacle.lane
        obstacle.crashed = obstacle.pushed = 0
