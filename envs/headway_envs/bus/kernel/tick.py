"""The entries of the kernel: begin, step, and the turn of the day."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from headway_envs.bus.kernel.compiled import compiled, compiled_allocating
from headway_envs.bus.kernel.day import begin_day, end_day
from headway_envs.bus.kernel.layout import Network, Outputs, Record, Trace, World
from headway_envs.bus.kernel.motion import advance
from headway_envs.bus.kernel.observe import observe, observe_state
from headway_envs.bus.kernel.rewards import pay
from headway_envs.bus.kernel.spacing import space_line
from headway_envs.bus.kernel.upkeep import foresee, upkeep_ahead


@compiled
def _look(net: Network, k: Record, world: World, outputs: Outputs, c: int) -> None:
    """Fill what the agents and critics of copy c face now."""
    observe(net, k, world, c, outputs.observations[c], outputs.alive[c], outputs.masks[c])
    if outputs.states.shape[1] > 0:
        observe_state(net, k, world, c, outputs.observations[c], outputs.states[c])


@compiled
def _space(net: Network, k: Record, world: World, c: int) -> None:
    for line in range(net.line_slots.shape[0] - 1):
        space_line(net, k, world, c, line)


@compiled_allocating
def _begin(
    net: Network, k: Record, world: World, outputs: Outputs, c: int, seed: np.uint64, episode: int
) -> None:
    begin_day(net, k, world, c, seed, episode)
    world.lines[c] = np.zeros(1, world.lines.dtype)[0]
    _space(net, k, world, c)
    for n in range(world.slots.shape[1]):
        world.slots[c, n].upkeep_ahead = upkeep_ahead(net, k, world, c, n)
    _look(net, k, world, outputs, c)


@compiled_allocating
def begin(
    net: Network, settings: NDArray[Any], world: World, outputs: Outputs, seeds: NDArray[np.uint64]
) -> None:
    """Begin day 0 of every copy."""
    for c in range(seeds.shape[0]):
        _begin(net, settings[0], world, outputs, c, seeds[c], 0)


@compiled
def step(
    net: Network,
    settings: NDArray[Any],
    world: World,
    outputs: Outputs,
    actions: NDArray[np.int64],
    trace: Trace,
) -> bool:
    """Advance every copy by one control interval; returns whether the day of any has ended, which `turn`
    must then follow. The trace keeps the day that has ended until the next interval."""
    k = settings[0]
    ended = False
    for c in range(actions.shape[0]):
        outputs.acting[c] = False
        advance(net, k, world, c, actions[c], outputs.acting[c], trace)
        _space(net, k, world, c)
        pay(net, k, world, c, outputs.rewards[c])
        if k.foresee_upkeep:
            foresee(net, k, world, c, outputs.rewards[c])
        _look(net, k, world, outputs, c)
        outputs.ended[c] = world.days[c].now >= k.end_s
        ended = ended or outputs.ended[c]
    return ended


@compiled_allocating
def turn(net: Network, settings: NDArray[Any], world: World, outputs: Outputs) -> None:
    """Close the books of every copy whose day has ended, and begin its next day."""
    k = settings[0]
    for c in range(outputs.ended.shape[0]):
        if outputs.ended[c]:
            outputs.final_observations[c] = outputs.observations[c]
            outputs.final_states[c] = outputs.states[c]
            end_day(net, k, world, c, outputs.metrics[c])
            day = world.days[c]
            _begin(net, k, world, outputs, c, day.seed, day.episode + 1)
