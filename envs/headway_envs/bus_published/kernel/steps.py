"""The entries of the kernel: begin and step."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from headway_envs.bus_published.kernel.compiled import compiled, compiled_apart
from headway_envs.bus_published.kernel.layout import FUEL_CAPACITY, Network, Outputs, Record, World
from headway_envs.bus_published.kernel.motion import act
from headway_envs.bus_published.kernel.observe import look
from headway_envs.bus_published.kernel.rewards import close_books
from headway_envs.keyed_random import episode_key, uniform

_CENTRE = 1
"""Purpose of the draw."""


@compiled
def _begin_day(net: Network, k: Record, world: World, c: int, seed: np.uint64, number: int) -> None:
    """All buses at the beginning of their routes, full and as new. The centre follows from the copy's seed
    alone: it is the same on all its days."""
    day = world.days[c]
    day.seed, day.number = seed, number
    day.step = day.moves = day.waits = day.services = day.refused = 0
    day.reward = day.uptime = day.occupancy = day.regularity = day.efficiency = 0.0
    many = net.centres.shape[0]
    drawn = int(uniform(episode_key(seed, 0), _CENTRE, 0, 0) * many)
    day.centre = net.centres[min(drawn, many - 1)]
    for n in range(world.buses.shape[1]):
        bus = world.buses[c, n]
        call = net.route_call[net.route_first[n // k.agents_per_route]]
        bus.clock, bus.driven = k.start_s, 0.0
        # The released code takes the mean occupancy there without its decimals.
        bus.occupancy = 1.0 if net.occupancy[call] >= 1.0 else 0.0
        bus.uptime, bus.fuel = 1.0, FUEL_CAPACITY
        bus.place = bus.backward = 0
        bus.stop = net.call_stop[call]
    for call in range(world.calls.shape[1]):
        world.calls[c, call].arrivals = world.calls[c, call].intervals = 0
        world.calls[c, call].last = world.calls[c, call].squares = 0.0


@compiled_apart
def begin(
    net: Network, settings: NDArray[Any], world: World, outputs: Outputs, seeds: NDArray[np.uint64]
) -> None:
    """Begin day 0 of every copy."""
    for c in range(seeds.shape[0]):
        _begin_day(net, settings[0], world, c, seeds[c], 0)
        look(net, settings[0], world, outputs, c)


@compiled
def _act_all(
    net: Network, k: Record, world: World, c: int, actions: NDArray[np.int64], rewards: NDArray[np.float32]
) -> None:
    """Let the buses of a copy take their actions (N,), in order, and pay them (N,)."""
    total = 0.0
    for n in range(actions.shape[0]):
        paid = act(net, k, world, c, n, actions[n])
        rewards[n] = paid
        total += paid
    world.days[c].step += 1
    world.days[c].reward += total
    if k.shared:
        rewards[:] = total / actions.shape[0]


@compiled
def _end_if_over(net: Network, k: Record, world: World, outputs: Outputs, c: int) -> None:
    """The day ends for all when one clock has passed the end, or is cut short after too many steps."""
    day, over = world.days[c], False
    for n in range(world.buses.shape[1]):
        over = over or world.buses[c, n].clock >= k.end_s
    outputs.ended[c] = over or day.step >= k.max_steps
    outputs.terminated[c] = over
    outputs.truncated[c] = outputs.ended[c] and not over
    if outputs.ended[c]:
        for n in range(outputs.observations.shape[1]):
            for d in range(outputs.observations.shape[2]):
                outputs.final_observations[c, n, d] = outputs.observations[c, n, d]
        close_books(day, outputs.metrics[c])
        _begin_day(net, k, world, c, day.seed, day.number + 1)
        look(net, k, world, outputs, c)


@compiled_apart
def step(
    net: Network,
    settings: NDArray[Any],
    world: World,
    outputs: Outputs,
    actions: NDArray[np.int64],
) -> None:
    """Let every bus of every copy take its action, in order; actions (C, N)."""
    k = settings[0]
    for c in range(actions.shape[0]):
        _act_all(net, k, world, c, actions[c], outputs.rewards[c])
        look(net, k, world, outputs, c)
        _end_if_over(net, k, world, outputs, c)
