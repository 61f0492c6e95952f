"""The priority-based safety supervisor of Chen et al. 2022 (arXiv:2105.05701).

It treats one CAV after another, the lowest priority value first: the motion of the CAV and of its neighbours
is predicted for one second, and an action that would end in a collision is replaced by the allowed action
with the most clearance.
"""

import math

import numpy as np
from numpy.typing import NDArray

from headway_envs.keyed_random import uniform
from headway_envs.merge.kernel.compiled import compiled, compiled_apart
from headway_envs.merge.kernel.contact import overlaps
from headway_envs.merge.kernel.control import apply_action, control
from headway_envs.merge.kernel.drivers import follow_target_lane
from headway_envs.merge.kernel.layout import (
    ACTIONS,
    AS_HUMAN,
    FASTER,
    LEFT,
    MERGING_LENGTH,
    PREDICTED_STEPS,
    RAMP_END,
    RIGHT,
    SLOWER,
    SPEED_STEP,
    STEP_S,
    Network,
    Record,
    Workspace,
    World,
)
from headway_envs.merge.kernel.motion import move
from headway_envs.merge.kernel.observe import fill_action_mask
from headway_envs.merge.kernel.spawn import PREDICTION_NOISE, PRIORITY
from headway_envs.merge.kernel.surroundings import adjacent_vehicles, gap_ahead, right_neighbour_lane

_FREE_CLEARANCE = 100.0


@compiled
def _priority(net: Network, k: Record, cars: NDArray[np.void], moving: int, ego: int) -> float:
    """Return the priority of a CAV; the lowest is treated first."""
    car, priority = cars[ego], 0.0
    if car.speed > 0.0:
        gap = gap_ahead(net, cars, moving, ego)
        priority = 0.5 * math.log(gap / (k.headway_s * car.speed))
    if net.lanes[car.lane].merging:
        priority -= 0.5 + (MERGING_LENGTH - (RAMP_END - car.x)) / MERGING_LENGTH
    return priority


@compiled
def _apply_action(net: Network, k: Record, ghost: Record, action: int, first: bool) -> None:
    """Apply an action at the first predicted step or, as in the study's supervisor, again at each."""
    if first:
        apply_action(net, k, ghost, action)
    elif not k.single_action_ahead:
        if action in (LEFT, RIGHT):
            apply_action(net, k, ghost, action)
        elif action in (FASTER, SLOWER):
            ghost.target_speed += SPEED_STEP if action == FASTER else -SPEED_STEP
    control(net, k, ghost)


@compiled_apart
def _predict_neighbour(
    net: Network, k: Record, world: World, c: int, work: Workspace, row: int, ego: int, action: int, draw: int
) -> None:
    """Predict the motion of a neighbour: a CAV applies its action; a human driver keeps its current steering
    and acceleration, each known to within 5%."""
    episode, cars, ghost = world.episodes[c], world.cars[c], work.ghosts[0]
    work.ghosts[0] = cars[ego]
    is_human = cars[ego].human
    if is_human:
        bodies = episode.cars + net.obstacles.shape[0]
        follow_target_lane(net, k, cars, episode.cars, bodies, ego, ghost)
        ghost.steering *= 0.95 + 0.1 * uniform(episode.key, PREDICTION_NOISE, episode.step, 2 * draw)
        ghost.acceleration *= 0.95 + 0.1 * uniform(episode.key, PREDICTION_NOISE, episode.step, 2 * draw + 1)
    steering, acceleration = ghost.steering, ghost.acceleration
    for step in range(PREDICTED_STEPS):
        if is_human:
            ghost.steering, ghost.acceleration = steering, acceleration
        else:
            _apply_action(net, k, ghost, action, step == 0)
        move(net, ghost, STEP_S)
        pose = work.predicted[row, step]
        pose[0], pose[1], pose[2], pose[3] = ghost.x, ghost.y, ghost.cosine, ghost.sine


@compiled
def _collides(
    net: Network,
    k: Record,
    world: World,
    c: int,
    work: Workspace,
    next_to: tuple[int, int, int, int],
    step: int,
) -> bool:
    """Return whether the ghost overlaps an obstacle or a neighbour at a predicted step."""
    episode, cars, ghost = world.episodes[c], world.cars[c], work.ghosts[0]
    for o in range(net.obstacles.shape[0]):
        if overlaps(k, ghost, cars[episode.cars + o], True):
            return True
    other = work.ghosts[1]
    for row in range(4):
        if next_to[row] < 0:
            continue
        pose = work.predicted[row, step]
        other.x, other.y, other.cosine, other.sine = pose[0], pose[1], pose[2], pose[3]
        if overlaps(k, ghost, other, False):
            return True
    return False


@compiled
def _clearance(
    net: Network, work: Workspace, next_to: tuple[int, int, int, int], step: int, action: int
) -> float:
    """Return the least distance of the ghost to the end of the ramp and to the relevant neighbours, m."""
    ghost = work.ghosts[0]
    lane = net.lanes[ghost.lane]
    clearance = RAMP_END - ghost.x if lane.merging else _FREE_CLEARANCE
    if action in (LEFT, RIGHT):
        for row in range(4):
            if next_to[row] >= 0:
                clearance = min(clearance, abs(work.predicted[row, step, 0] - ghost.x))
        return clearance
    # The ego lane is the left one of the pair on the highway, the right one on the ramp.
    row = 0 if lane.left == ghost.lane else 2
    if next_to[row] >= 0:
        clearance = min(clearance, work.predicted[row, step, 0] - ghost.x)
    return clearance


@compiled_apart
def _first_collision(
    net: Network,
    k: Record,
    world: World,
    c: int,
    work: Workspace,
    next_to: tuple[int, int, int, int],
    ego: int,
    action: int,
) -> int:
    """Return the predicted step at which an action causes a collision; -1: none."""
    work.ghosts[0] = world.cars[c, ego]
    ghost = work.ghosts[0]
    for step in range(PREDICTED_STEPS):
        _apply_action(net, k, ghost, action, step == 0)
        move(net, ghost, STEP_S)
        if _collides(net, k, world, c, work, next_to, step):
            return step
    return -1


@compiled_apart
def _safest_action(
    net: Network,
    k: Record,
    world: World,
    c: int,
    work: Workspace,
    next_to: tuple[int, int, int, int],
    ego: int,
    steps: int,
) -> int:
    """Return the allowed action with the largest minimum clearance over `steps` steps; ties: the first."""
    fill_action_mask(net, k, world.cars[c, ego], work.allowed)
    most, found = -np.inf, 1
    for action in range(ACTIONS):
        if not work.allowed[action]:
            continue
        work.ghosts[0] = world.cars[c, ego]
        ghost, clearance = work.ghosts[0], np.inf
        for step in range(steps):
            _apply_action(net, k, ghost, action, step == 0)
            move(net, ghost, STEP_S)
            clearance = min(clearance, _clearance(net, work, next_to, step, action))
        if clearance > most:
            most, found = clearance, action
    return found


@compiled_apart
def supervise(
    net: Network, k: Record, world: World, c: int, work: Workspace, actions: NDArray[np.int64]
) -> None:
    """Replace the actions (N,) of copy c that are predicted to cause a collision."""
    episode, cars = world.episodes[c], world.cars[c]
    for i in range(episode.cavs):
        # Decides between equal priorities; too small to reorder others.
        spread = 0.001 * uniform(episode.key, PRIORITY, episode.step, i)
        work.priorities[i] = _priority(net, k, cars, episode.cars, i) + spread
    for _ in range(episode.cavs):
        ego = 0
        for i in range(episode.cavs):
            if work.priorities[i] < work.priorities[ego]:
                ego = i
        work.priorities[ego] = np.inf
        if actions[ego] == AS_HUMAN:
            continue
        left = adjacent_vehicles(net, cars, episode.cars, ego, net.lanes[cars[ego].lane].left)
        right = adjacent_vehicles(net, cars, episode.cars, ego, right_neighbour_lane(net, cars, ego))
        next_to = (left[0], left[1], right[0], right[1])
        for row in range(4):
            other = next_to[row]
            if other >= 0:
                # CAVs treated earlier already have their final action.
                action = actions[other] if other < episode.cavs else 0
                _predict_neighbour(net, k, world, c, work, row, other, action, 16 * ego + row)
        collision = _first_collision(net, k, world, c, work, next_to, ego, actions[ego])
        if collision >= 0:
            action = _safest_action(net, k, world, c, work, next_to, ego, collision + 1)
            if action != actions[ego]:
                actions[ego] = action
                episode.interventions += 1
