"""Functions of the kernel that the environment calls: begin and step."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from headway_envs.bus_published.kernel.compiled import compiled, compiled_apart
from headway_envs.bus_published.kernel.layout import FUEL_CAPACITY, Network, Outputs, Record, World
from headway_envs.bus_published.kernel.motion import act
from headway_envs.bus_published.kernel.observe import observe
from headway_envs.bus_published.kernel.rewards import fill_metrics
from headway_envs.keyed_random import episode_key, uniform

_CENTRE, _ROUTE = 1, 2
"""Purposes of the draws of the service centre and of the buses' routes."""


@compiled
def _begin_day(net: Network, k: Record, world: World, c: int, seed: np.uint64, number: int) -> None:
    """Put all buses of copy c at the start of their routes, refuelled and repaired, and draw the routes and
    the service centre. They depend on the copy's seed only: they are the same on all its days."""
    day = world.days[c]
    day.seed, day.number = seed, number
    day.step = day.moves = day.waits = day.services = day.refused = 0
    day.reward = day.uptime = day.occupancy = day.regularity = day.efficiency = 0.0
    key, count = episode_key(seed, 0), net.centres.shape[0]
    day.centre = net.centres[min(int(uniform(key, _CENTRE, 0, 0) * count), count - 1)]
    for n in range(world.buses.shape[1]):
        bus = world.buses[c, n]
        bus.route, drawn = 0, uniform(key, _ROUTE, n, 0)
        while net.route_share[bus.route] < drawn:
            bus.route += 1
        bus.stop = net.route_stop[net.route_first[bus.route]]
        bus.clock, bus.driven = k.start_s, 0.0
        # The released code truncates the mean occupancy at the first stop to an integer.
        bus.occupancy = 1.0 if net.occupancy[bus.stop] >= 1.0 else 0.0
        bus.uptime, bus.fuel = 1.0, FUEL_CAPACITY
        bus.place = bus.backward = 0
    for stop in range(world.stops.shape[1]):
        world.stops[c, stop].arrivals = world.stops[c, stop].intervals = 0
        world.stops[c, stop].last = world.stops[c, stop].squares = 0.0


@compiled_apart
def begin(
    net: Network, settings: NDArray[Any], world: World, outputs: Outputs, seeds: NDArray[np.uint64]
) -> None:
    """Begin day 0 of every copy."""
    for c in range(seeds.shape[0]):
        _begin_day(net, settings[0], world, c, seeds[c], 0)
        observe(net, settings[0], world, outputs, c)


@compiled
def _act_all(
    net: Network, k: Record, world: World, c: int, actions: NDArray[np.int64], rewards: NDArray[np.float32]
) -> None:
    """Apply the actions (N,) of a copy's buses, in order, and fill their rewards (N,)."""
    total = 0.0
    for n in range(actions.shape[0]):
        reward = act(net, k, world, c, n, actions[n])
        rewards[n] = reward
        total += reward
    world.days[c].step += 1
    world.days[c].reward += total
    if k.shared:
        rewards[:] = total / actions.shape[0]


@compiled
def _finish_if_over(net: Network, k: Record, world: World, outputs: Outputs, c: int) -> None:
    """End the day of copy c once one clock has passed the end, or truncate it after `max_steps`; then fill
    the metrics and begin the next day."""
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
        fill_metrics(day, outputs.metrics[c])
        _begin_day(net, k, world, c, day.seed, day.number + 1)
        observe(net, k, world, outputs, c)


@compiled_apart
def step(
    net: Network,
    settings: NDArray[Any],
    world: World,
    outputs: Outputs,
    actions: NDArray[np.int64],
) -> None:
    """Apply the actions (C, N) of every bus of every copy, in order."""
    k = settings[0]
    for c in range(actions.shape[0]):
        _act_all(net, k, world, c, actions[c], outputs.rewards[c])
        observe(net, k, world, outputs, c)
        _finish_if_over(net, k, world, outputs, c)
