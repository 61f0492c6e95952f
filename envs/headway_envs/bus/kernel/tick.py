"""Functions of the kernel that the environment calls: begin, step, and the start of the next days."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from headway_envs.bus.kernel.compiled import compiled, compiled_allocating
from headway_envs.bus.kernel.day import begin_day, end_day
from headway_envs.bus.kernel.layout import Network, Outputs, Record, Trace, World
from headway_envs.bus.kernel.motion import advance
from headway_envs.bus.kernel.observe import observe, observe_state
from headway_envs.bus.kernel.rewards import assign_rewards
from headway_envs.bus.kernel.spacing import update_line_spacings
from headway_envs.bus.kernel.upkeep import shape_rewards, upkeep_potential


@compiled
def _observe_copy(net: Network, k: Record, world: World, outputs: Outputs, c: int) -> None:
    """Fill the observations and the state of copy c."""
    observe(net, k, world, c, outputs.observations[c], outputs.alive[c], outputs.masks[c])
    if outputs.states.shape[1] > 0:
        observe_state(net, k, world, c, outputs.observations[c], outputs.states[c])


@compiled
def _update_spacings(net: Network, k: Record, world: World, c: int) -> None:
    for line in range(net.line_slots.shape[0] - 1):
        update_line_spacings(net, k, world, c, line)


@compiled_allocating
def _begin_copy(
    net: Network, k: Record, world: World, outputs: Outputs, c: int, seed: np.uint64, episode: int
) -> None:
    begin_day(net, k, world, c, seed, episode)
    world.lines[c] = np.zeros(1, world.lines.dtype)[0]
    _update_spacings(net, k, world, c)
    for n in range(world.slots.shape[1]):
        world.slots[c, n].upkeep_ahead = upkeep_potential(net, k, world, c, n)
    _observe_copy(net, k, world, outputs, c)


@compiled_allocating
def begin(
    net: Network, settings: NDArray[Any], world: World, outputs: Outputs, seeds: NDArray[np.uint64]
) -> None:
    """Begin day 0 of every copy."""
    for c in range(seeds.shape[0]):
        _begin_copy(net, settings[0], world, outputs, c, seeds[c], 0)


@compiled
def step(
    net: Network,
    settings: NDArray[Any],
    world: World,
    outputs: Outputs,
    actions: NDArray[np.int64],
    trace: Trace,
) -> bool:
    """Advance every copy by one control interval. Return whether the day of any copy has ended;
    `start_next_days` must then follow. The trace keeps a finished day until the next interval."""
    k = settings[0]
    ended = False
    for c in range(actions.shape[0]):
        outputs.acting[c] = False
        advance(net, k, world, c, actions[c], outputs.acting[c], trace)
        _update_spacings(net, k, world, c)
        assign_rewards(net, k, world, c, outputs.rewards[c])
        if k.foresee_upkeep:
            shape_rewards(net, k, world, c, outputs.rewards[c])
        _observe_copy(net, k, world, outputs, c)
        outputs.ended[c] = world.days[c].now >= k.end_s
        ended = ended or outputs.ended[c]
    return ended


@compiled_allocating
def start_next_days(net: Network, settings: NDArray[Any], world: World, outputs: Outputs) -> None:
    """Fill the metrics of every copy whose day has ended, keep its last observations, and begin its next
    day."""
    k = settings[0]
    for c in range(outputs.ended.shape[0]):
        if outputs.ended[c]:
            outputs.final_observations[c] = outputs.observations[c]
            outputs.final_states[c] = outputs.states[c]
            end_day(net, k, world, c, outputs.metrics[c])
            day = world.days[c]
            _begin_copy(net, k, world, outputs, c, day.seed, day.episode + 1)
