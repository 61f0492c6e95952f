"""The priority-based safety supervisor of Chen et al. 2022 (arXiv:2105.05701).

One CAV after another, the most pressed first: its way is foreseen for a second among those of its neighbours,
and an action that would end in a collision gives way to the one that keeps the most room.
"""

import math

import numpy as np
from numpy.typing import NDArray

from headway_envs.keyed_random import uniform
from headway_envs.merge.kernel.compiled import compiled, compiled_apart
from headway_envs.merge.kernel.contact import touch
from headway_envs.merge.kernel.control import control, decide
from headway_envs.merge.kernel.drivers import keep_on
from headway_envs.merge.kernel.layout import (
    ACTIONS,
    AS_HUMAN,
    FASTER,
    FORESEEN,
    LEFT,
    MERGING_LENGTH,
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
from headway_envs.merge.kernel.motion import roll
from headway_envs.merge.kernel.observe import allow
from headway_envs.merge.kernel.spawn import PRIORITY, UNSURE
from headway_envs.merge.kernel.surroundings import gap_ahead, next_on, right_of

_FREE_ROOM = 100.0


@compiled
def _priority(net: Network, k: Record, cars: NDArray[np.void], moving: int, me: int) -> float:
    """The lower, the more pressed."""
    car, priority = cars[me], 0.0
    if car.speed > 0.0:
        gap = gap_ahead(net, cars, moving, me)
        priority = 0.5 * math.log(gap / (k.headway_s * car.speed))
    if net.lanes[car.lane].merging:
        priority -= 0.5 + (MERGING_LENGTH - (RAMP_END - car.x)) / MERGING_LENGTH
    return priority


@compiled
def _act(net: Network, k: Record, ghost: Record, action: int, first: bool) -> None:
    """Take an action, at the first step or, as the study's supervisor does, again in each."""
    if first:
        decide(net, k, ghost, action)
    elif not k.one_action_ahead:
        if action in (LEFT, RIGHT):
            decide(net, k, ghost, action)
        elif action in (FASTER, SLOWER):
            ghost.target_speed += SPEED_STEP if action == FASTER else -SPEED_STEP
    control(net, k, ghost)


@compiled_apart
def _foresee_neighbour(
    net: Network, k: Record, world: World, c: int, work: Workspace, row: int, me: int, action: int, draw: int
) -> None:
    """The way of a neighbour: a CAV takes its action, a human holds the steering and acceleration of now,
    each known to within 5%."""
    episode, cars, ghost = world.episodes[c], world.cars[c], work.ghosts[0]
    work.ghosts[0] = cars[me]
    is_human = cars[me].human
    if is_human:
        things = episode.cars + net.obstacles.shape[0]
        keep_on(net, k, cars, episode.cars, things, me, ghost)
        ghost.steering *= 0.95 + 0.1 * uniform(episode.key, UNSURE, episode.step, 2 * draw)
        ghost.acceleration *= 0.95 + 0.1 * uniform(episode.key, UNSURE, episode.step, 2 * draw + 1)
    steering, acceleration = ghost.steering, ghost.acceleration
    for step in range(FORESEEN):
        if is_human:
            ghost.steering, ghost.acceleration = steering, acceleration
        else:
            _act(net, k, ghost, action, step == 0)
        roll(net, ghost, STEP_S)
        way = work.ways[row, step]
        way[0], way[1], way[2], way[3] = ghost.x, ghost.y, ghost.cosine, ghost.sine


@compiled
def _hits(
    net: Network,
    k: Record,
    world: World,
    c: int,
    work: Workspace,
    next_to: tuple[int, int, int, int],
    step: int,
) -> bool:
    """Whether the ghost meets one of the neighbours, or an obstacle, at a step foreseen."""
    episode, cars, ghost = world.episodes[c], world.cars[c], work.ghosts[0]
    for o in range(net.obstacles.shape[0]):
        if touch(k, ghost, cars[episode.cars + o], True):
            return True
    other = work.ghosts[1]
    for row in range(4):
        if next_to[row] < 0:
            continue
        way = work.ways[row, step]
        other.x, other.y, other.cosine, other.sine = way[0], way[1], way[2], way[3]
        if touch(k, ghost, other, False):
            return True
    return False


@compiled
def _room(net: Network, work: Workspace, next_to: tuple[int, int, int, int], step: int, action: int) -> float:
    """Room of the ghost at a step foreseen: to the end of the ramp and to the vehicles that matter."""
    ghost = work.ghosts[0]
    lane = net.lanes[ghost.lane]
    room = RAMP_END - ghost.x if lane.merging else _FREE_ROOM
    if action in (LEFT, RIGHT):
        for row in range(4):
            if next_to[row] >= 0:
                room = min(room, abs(work.ways[row, step, 0] - ghost.x))
        return room
    # Its own lane is the left one of the pair on the highway, the right one on the ramp.
    row = 0 if lane.left == ghost.lane else 2
    if next_to[row] >= 0:
        room = min(room, work.ways[row, step, 0] - ghost.x)
    return room


@compiled_apart
def _first_hit(
    net: Network,
    k: Record,
    world: World,
    c: int,
    work: Workspace,
    next_to: tuple[int, int, int, int],
    me: int,
    action: int,
) -> int:
    """The step at which an action is foreseen to end in a collision; -1: none."""
    work.ghosts[0] = world.cars[c, me]
    ghost = work.ghosts[0]
    for step in range(FORESEEN):
        _act(net, k, ghost, action, step == 0)
        roll(net, ghost, STEP_S)
        if _hits(net, k, world, c, work, next_to, step):
            return step
    return -1


@compiled_apart
def _roomiest(
    net: Network,
    k: Record,
    world: World,
    c: int,
    work: Workspace,
    next_to: tuple[int, int, int, int],
    me: int,
    steps: int,
) -> int:
    """The allowed action that keeps the most room over so many steps; of equal ones the first."""
    allow(net, k, world.cars[c, me], work.allowed)
    most, found = -np.inf, 1
    for action in range(ACTIONS):
        if not work.allowed[action]:
            continue
        work.ghosts[0] = world.cars[c, me]
        ghost, room = work.ghosts[0], np.inf
        for step in range(steps):
            _act(net, k, ghost, action, step == 0)
            roll(net, ghost, STEP_S)
            room = min(room, _room(net, work, next_to, step, action))
        if room > most:
            most, found = room, action
    return found


@compiled_apart
def supervise(
    net: Network, k: Record, world: World, c: int, work: Workspace, actions: NDArray[np.int64]
) -> None:
    """Replace actions (N,) of copy c that are foreseen to end in a collision."""
    episode, cars = world.episodes[c], world.cars[c]
    for i in range(episode.cavs):
        spread = 0.001 * uniform(episode.key, PRIORITY, episode.step, i)
        work.priorities[i] = _priority(net, k, cars, episode.cars, i) + spread
    for _ in range(episode.cavs):
        me = 0
        for i in range(episode.cavs):
            if work.priorities[i] < work.priorities[me]:
                me = i
        work.priorities[me] = np.inf
        if actions[me] == AS_HUMAN:
            continue
        left = next_on(net, cars, episode.cars, me, net.lanes[cars[me].lane].left)
        right = next_on(net, cars, episode.cars, me, right_of(net, cars, me))
        next_to = (left[0], left[1], right[0], right[1])
        for row in range(4):
            other = next_to[row]
            if other >= 0:
                action = actions[other] if other < episode.cavs else 0
                _foresee_neighbour(net, k, world, c, work, row, other, action, 16 * me + row)
        hit = _first_hit(net, k, world, c, work, next_to, me, actions[me])
        if hit >= 0:
            action = _roomiest(net, k, world, c, work, next_to, me, hit + 1)
            if action != actions[me]:
                actions[me] = action
                episode.interventions += 1
