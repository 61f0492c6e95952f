"""Rewards of the CAVs and totals of the episode. Source: Chen et al. 2022 (arXiv:2105.05701), with the
weights of its code."""

import math

import numpy as np
from numpy.typing import NDArray

from headway_envs.merge.kernel.compiled import compiled
from headway_envs.merge.kernel.layout import MERGING_LENGTH, RAMP_END, Network, Record, World
from headway_envs.merge.kernel.surroundings import adjacent_vehicles, gap_ahead, right_neighbour_lane


@compiled
def _own_reward(net: Network, k: Record, car: Record, gap: float) -> float:
    """Return r of one CAV, with `gap` the distance to the vehicle ahead, m."""
    reward = -k.weight_collision * car.crashed
    reward += k.weight_speed * min(max((car.speed - 10.0) / 20.0, 0.0), 1.0)
    if net.lanes[car.lane].merging:
        left = car.x - RAMP_END
        reward -= k.weight_ramp_end * math.exp(-left * left / (10.0 * MERGING_LENGTH))
    if car.speed > 0.0:
        reward += k.weight_spacing * min(math.log(gap / (k.headway_s * car.speed)), 0.0)
    return float(reward)


@compiled
def _regional_reward(
    net: Network, cars: NDArray[np.void], cavs: int, moving: int, ego: int, own: NDArray[np.float32]
) -> float:
    """Return the mean of the own rewards of a CAV and the CAVs next to it."""
    total, count = float(own[ego]), 1
    for lane in (net.lanes[cars[ego].lane].left, right_neighbour_lane(net, cars, ego)):
        for other in adjacent_vehicles(net, cars, moving, ego, lane):
            if 0 <= other < cavs:
                total += own[other]
                count += 1
    return total / count


@compiled
def compute_rewards(
    net: Network, k: Record, world: World, c: int, rewards: NDArray[np.float32], own: NDArray[np.float32]
) -> None:
    """Fill the rewards (N,) of a step and update the totals; `own` (N,) is scratch space.

    Slots without a CAV receive the mean with scope `global`, else 0."""
    episode, cars = world.episodes[c], world.cars[c]
    total, speed = 0.0, 0.0
    for i in range(episode.cavs):
        car = cars[i]
        gap = gap_ahead(net, cars, episode.cars, i)
        own[i] = _own_reward(net, k, car, gap)
        total += own[i]
        speed += car.speed
        episode.min_speed = min(episode.min_speed, car.speed)
        episode.min_gap = min(episode.min_gap, gap)
        if car.speed > 0.0:
            episode.min_headway = min(episode.min_headway, gap / car.speed)
    for i in range(episode.cars):
        car = cars[i]
        if car.x > RAMP_END and net.lanes[car.lane].successor == car.lane and not car.crashed:
            car.merged = 1
    mean = total / episode.cavs
    episode.reward += mean
    episode.speed += speed / episode.cavs
    for n in range(rewards.shape[0]):
        if k.scope == 0:
            rewards[n] = mean
        elif n >= episode.cavs:
            rewards[n] = 0.0
        elif k.scope == 1:
            rewards[n] = _regional_reward(net, cars, episode.cavs, episode.cars, n, own)
        else:
            rewards[n] = own[n]


@compiled
def _share(count: int, total: int) -> float:
    return count / total if total > 0 else 0.0


@compiled
def fill_metrics(world: World, c: int, metrics: NDArray[np.float64]) -> None:
    """Fill the episode metrics, in the order of `metrics.METRICS`."""
    episode, cars = world.episodes[c], world.cars[c]
    merged, ramp, ramp_merged, humans_merged = 0, 0, 0, 0
    for i in range(episode.cars):
        if i >= episode.cavs:
            humans_merged += cars[i].merged
            continue
        merged += cars[i].merged
        if cars[i].from_ramp:
            ramp += 1
            ramp_merged += cars[i].merged
    steps = max(episode.step, 1)
    metrics[0] = episode.reward
    metrics[1] = episode.crash
    metrics[2] = _share(merged, episode.cavs)
    metrics[3] = _share(ramp_merged, ramp)
    metrics[4] = _share(humans_merged, episode.cars - episode.cavs)
    metrics[5] = episode.speed / steps
    metrics[6] = episode.min_speed
    metrics[7] = episode.min_gap
    metrics[8] = episode.min_headway if episode.min_headway < np.inf else 0.0
    metrics[9] = episode.step
    metrics[10] = episode.interventions
