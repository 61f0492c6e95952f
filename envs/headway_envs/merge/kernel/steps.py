"""Functions of the kernel that the environment calls: begin and step."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from headway_envs.merge.kernel.compiled import compiled, compiled_apart
from headway_envs.merge.kernel.control import apply_action
from headway_envs.merge.kernel.layout import (
    AS_HUMAN,
    STEP_S,
    SUBSTEPS,
    Network,
    Outputs,
    Record,
    Workspace,
    World,
)
from headway_envs.merge.kernel.motion import simulate
from headway_envs.merge.kernel.observe import observe
from headway_envs.merge.kernel.rewards import compute_rewards, fill_metrics
from headway_envs.merge.kernel.spawn import begin_episode
from headway_envs.merge.kernel.supervisor import supervise


@compiled_apart
def begin(
    net: Network, settings: NDArray[Any], world: World, outputs: Outputs, seeds: NDArray[np.uint64]
) -> None:
    """Begin episode 0 of every copy."""
    for c in range(seeds.shape[0]):
        begin_episode(net, settings[0], world, c, seeds[c], 0)
        observe(net, settings[0], world, outputs, c)


@compiled
def _cavs_crashed(world: World, c: int) -> int:
    crashed = 0
    for i in range(world.episodes[c].cavs):
        crashed += world.cars[c, i].crashed
    return crashed


@compiled
def apply_actions(
    net: Network, k: Record, cars: NDArray[np.void], cavs: int, actions: NDArray[np.int64]
) -> None:
    """Apply the actions (N,) of the CAVs."""
    for i in range(cavs):
        car = cars[i]
        if actions[i] == AS_HUMAN:
            car.human = 1
            car.target_speed = car.desired_speed
        else:
            car.human = 0
            apply_action(net, k, car, actions[i])


@compiled
def _advance(net: Network, k: Record, world: World, c: int, actions: NDArray[np.int64]) -> None:
    episode, cars = world.episodes[c], world.cars[c]
    apply_actions(net, k, cars, episode.cavs, actions)
    episode.step += 1
    for _ in range(SUBSTEPS):
        simulate(net, k, cars, episode.cars, episode.cars + net.obstacles.shape[0], STEP_S)
        if k.ends_within_step and (episode.step >= k.steps or _cavs_crashed(world, c) > 0):
            break
    if _cavs_crashed(world, c) > 0:
        episode.crash = 1


@compiled
def _end(net: Network, k: Record, world: World, outputs: Outputs, c: int) -> None:
    """Fill the final arrays and metrics of a copy whose episode has ended, and begin its next episode."""
    episode = world.episodes[c]
    over = episode.crash or k.time_is_terminal
    outputs.ended[c] = True
    outputs.terminated[c] = over
    outputs.truncated[c] = not over
    for n in range(outputs.alive.shape[1]):
        for d in range(outputs.observations.shape[2]):
            outputs.final_observations[c, n, d] = outputs.observations[c, n, d]
    for d in range(outputs.states.shape[1]):
        outputs.final_states[c, d] = outputs.states[c, d]
    outputs.final_episodes[c] = episode
    for i in range(world.cars.shape[1]):
        outputs.final_cars[c, i] = world.cars[c, i]
    fill_metrics(world, c, outputs.metrics[c])
    begin_episode(net, k, world, c, episode.seed, episode.number + 1)
    observe(net, k, world, outputs, c)


@compiled_apart
def step(
    net: Network,
    settings: NDArray[Any],
    world: World,
    work: Workspace,
    outputs: Outputs,
    actions: NDArray[np.int64],
) -> None:
    """Advance every copy by one step of the agents; the supervisor may replace entries of actions (C, N)."""
    k = settings[0]
    for c in range(actions.shape[0]):
        outputs.ended[c] = False
        outputs.terminated[c] = False
        outputs.truncated[c] = False
        for n in range(actions.shape[1]):
            outputs.acting[c, n] = outputs.alive[c, n]
        if k.supervisor:
            supervise(net, k, world, c, work, actions[c])
        _advance(net, k, world, c, actions[c])
        compute_rewards(net, k, world, c, outputs.rewards[c], work.own)
        observe(net, k, world, outputs, c)
        if world.episodes[c].crash or world.episodes[c].step >= k.steps:
            _end(net, k, world, outputs, c)
