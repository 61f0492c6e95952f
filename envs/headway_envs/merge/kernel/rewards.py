"""What CAVs are paid, and the accounts of the episode. Source: Chen et al. 2022 (arXiv:2105.05701), with the
weights of its code."""

import math

import numpy as np
from numpy.typing import NDArray

from headway_envs.merge.kernel.compiled import compiled
from headway_envs.merge.kernel.layout import MERGING_LENGTH, RAMP_END, Network, Record, World
from headway_envs.merge.kernel.surroundings import gap_ahead, next_on, right_of


@compiled
def _own(net: Network, k: Record, car: Record, gap: float) -> float:
    """r of one CAV, whose vehicle ahead is `gap` m away."""
    reward = -k.weight_collision * car.crashed
    reward += k.weight_speed * min(max((car.speed - 10.0) / 20.0, 0.0), 1.0)
    if net.lanes[car.lane].merging:
        left = car.x - RAMP_END
        reward -= k.weight_ramp_end * math.exp(-left * left / (10.0 * MERGING_LENGTH))
    if car.speed > 0.0:
        reward += k.weight_spacing * min(math.log(gap / (k.headway_s * car.speed)), 0.0)
    return float(reward)


@compiled
def _of_region(
    net: Network, cars: NDArray[np.void], cavs: int, moving: int, me: int, own: NDArray[np.float32]
) -> float:
    """Mean of the own rewards of a CAV and of the CAVs next to it."""
    total, count = float(own[me]), 1
    for lane in (net.lanes[cars[me].lane].left, right_of(net, cars, me)):
        for other in next_on(net, cars, moving, me, lane):
            if 0 <= other < cavs:
                total += own[other]
                count += 1
    return total / count


@compiled
def pay(
    net: Network, k: Record, world: World, c: int, rewards: NDArray[np.float32], own: NDArray[np.float32]
) -> None:
    """Rewards (N,) of the step just taken, and the accounts; `own` (N,) is memory to work in.

    Slots without a CAV are paid the mean where all are, else 0."""
    episode, cars = world.episodes[c], world.cars[c]
    total, speed = 0.0, 0.0
    for i in range(episode.cavs):
        car = cars[i]
        gap = gap_ahead(net, cars, episode.cars, i)
        own[i] = _own(net, k, car, gap)
        total += own[i]
        speed += car.speed
        episode.least_speed = min(episode.least_speed, car.speed)
        episode.least_gap = min(episode.least_gap, gap)
        if car.speed > 0.0:
            episode.least_headway = min(episode.least_headway, gap / car.speed)
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
            rewards[n] = _of_region(net, cars, episode.cavs, episode.cars, n, own)
        else:
            rewards[n] = own[n]


@compiled
def _share(count: int, of: int) -> float:
    return count / of if of > 0 else 0.0


@compiled
def close_books(world: World, c: int, metrics: NDArray[np.float64]) -> None:
    """Fill the episode metrics, in the order of `layout.METRICS`."""
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
    metrics[6] = episode.least_speed
    metrics[7] = episode.least_gap
    metrics[8] = episode.least_headway if episode.least_headway < np.inf else 0.0
    metrics[9] = episode.step
    metrics[10] = episode.interventions
