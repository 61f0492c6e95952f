"""The beginning of an episode: who is where, and how fast."""

import numpy as np

from headway_envs.keyed_random import episode_key, uniform
from headway_envs.merge.kernel.compiled import compiled, compiled_apart
from headway_envs.merge.kernel.control import speed_index
from headway_envs.merge.kernel.lanes import closest
from headway_envs.merge.kernel.layout import SLOWEST, SPEED_STEP, Network, Record, World

NUMBER, PLACE, RAMP, SPEED, OFFSET, PRIORITY, UNSURE = 1, 2, 3, 4, 5, 6, 7
"""Purposes of draws; the last two are the supervisor's."""

PLACES, PLACES_APART = 6, 40.0
HIGHWAY_FROM, RAMP_FROM = 10.0, 5.0
"""Vehicles begin at six places on the highway and six on the ramp, 40 m apart."""


@compiled
def _whole(key: np.uint64, index: int, low: int, high: int) -> int:
    return low + int(uniform(key, NUMBER, index, 0) * (high - low + 1))


@compiled
def _take(key: np.uint64, index: int, taken: int) -> int:
    """One of the places that are left; `taken` has a bit set for each that is not."""
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
def _put(net: Network, key: np.uint64, car: Record, index: int, lane_index: int, x: float) -> None:
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
    car.lane = closest(net.lanes, car.x, car.y, car.heading)
    car.target_lane = car.lane


@compiled_apart
def begin_episode(net: Network, k: Record, world: World, c: int, seed: np.uint64, number: int) -> None:
    """Reset copy c to the beginning of an episode.

    Of the CAVs and of the HDVs alike one half begins on the highway and the other, larger by one where their
    number is odd, on the ramp, where each is on the inner or outer lane by the toss of a coin."""
    episode, cars = world.episodes[c], world.cars[c]
    key = episode_key(seed, number)
    episode.seed, episode.key, episode.number, episode.step = seed, key, number, 0
    episode.cavs = _whole(key, 0, k.fewest_cavs, k.most_cavs)
    hdvs = _whole(key, 1, k.fewest_hdvs, k.most_hdvs)
    episode.cars = episode.cavs + hdvs
    episode.crash = episode.interventions = 0
    episode.reward = episode.speed = 0.0
    episode.least_speed = episode.least_gap = episode.least_headway = np.inf
    highway, ramp = 0, 0
    for i in range(episode.cars):
        is_cav = i < episode.cavs
        rank, group = (i, episode.cavs) if is_cav else (i - episode.cavs, hdvs)
        car = cars[i]
        car.from_ramp = 0 if rank < group // 2 else 1
        if car.from_ramp:
            place = _take(key, i, ramp)
            ramp |= 1 << place
            outer = k.ramp_lanes == 2 and uniform(key, RAMP, i, 0) < 0.5
            _put(net, key, car, i, net.spawn[2 if outer else 1], RAMP_FROM + PLACES_APART * place)
        else:
            place = _take(key, i, highway)
            highway |= 1 << place
            _put(net, key, car, i, net.spawn[0], HIGHWAY_FROM + PLACES_APART * place)
        car.human = 0 if is_cav else 1
        car.target_speed = SLOWEST + SPEED_STEP * speed_index(car.speed) if is_cav else car.desired_speed
    for o in range(net.obstacles.shape[0]):
        obstacle = cars[episode.cars + o]
        obstacle.x, obstacle.y = net.obstacles[o, 0], net.obstacles[o, 1]
        obstacle.heading = obstacle.sine = obstacle.speed = 0.0
        obstacle.cosine = 1.0
        obstacle.lane = closest(net.lanes, obstacle.x, obstacle.y, 0.0)
        obstacle.target_lane = obstacle.lane
        obstacle.crashed = obstacle.pushed = 0
