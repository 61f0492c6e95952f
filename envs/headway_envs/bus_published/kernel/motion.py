"""Action of one bus: wait, move to the next stop, or go to service."""

import math

from headway_envs.bus_published.kernel.compiled import compiled
from headway_envs.bus_published.kernel.layout import (
    DETOUR_SHARE,
    FUEL_CAPACITY,
    FUEL_UNIT_S,
    MOVE,
    REFUSED_REWARD,
    SERVICE_REWARD_S,
    UPTIME_S,
    WAIT,
    WAIT_REWARD,
    WAIT_S,
    Network,
    Record,
    World,
)
from headway_envs.bus_published.kernel.rewards import move_reward, occupancy_cost, record_arrival


@compiled
def _pass_time(bus: Record, seconds: float) -> None:
    """Advance the clock of a bus, and reduce its uptime and fuel."""
    bus.clock += seconds
    bus.uptime = max(bus.uptime - seconds / UPTIME_S, 0.0)
    bus.fuel = max(bus.fuel - seconds / FUEL_UNIT_S, 0.0)


@compiled
def _next_place(bus: Record, length: int) -> int:
    """Return the bus's next position on its route. At either end the bus turns and leaves with the same
    action."""
    if bus.backward == 0 and bus.place + 1 >= length:
        bus.backward = 1
    elif bus.backward == 1 and bus.place == 0:
        bus.backward = 0
    return int(bus.place + (1 - 2 * bus.backward))


@compiled
def _move(net: Network, k: Record, world: World, c: int, bus: Record) -> float:
    """Drive to the next stop and return the reward. The occupancy moves halfway to the mean at the stop that
    the bus leaves, if it is known."""
    first, day, left = net.route_first[bus.route], world.days[c], bus.stop
    bus.place = _next_place(bus, net.route_first[bus.route + 1] - first)
    bus.stop = net.route_stop[first + bus.place]
    seconds = net.travel_s[left, bus.stop]
    if not math.isnan(net.occupancy[left]):
        bus.occupancy = min(max(0.5 * (bus.occupancy + net.occupancy[left]), 0.0), 1.0)
    _pass_time(bus, seconds)
    bus.driven += seconds
    cost = occupancy_cost(k, bus.occupancy)
    regularity = record_arrival(k, world.stops[c, bus.stop], bus.clock)
    efficiency = min(max(1.0 - bus.driven / net.expected_s[bus.route], 0.0), 1.0)
    day.moves += 1
    day.occupancy += cost
    day.uptime += bus.uptime
    day.regularity += regularity
    day.efficiency += efficiency
    return move_reward(k, cost, bus.uptime, regularity, efficiency)


@compiled
def _serve(net: Network, world: World, c: int, bus: Record) -> float:
    """Drive to the centre, if the fuel lasts, and return the reward. The bus is refuelled, repaired and back
    at its position at once."""
    day = world.days[c]
    seconds = DETOUR_SHARE * net.detour_s[bus.stop, day.centre]
    if bus.fuel < seconds / FUEL_UNIT_S:
        day.refused += 1
        return REFUSED_REWARD
    bus.clock += seconds
    bus.driven += seconds
    bus.fuel, bus.uptime = FUEL_CAPACITY, 1.0
    bus.stop = day.centre
    day.services += 1
    return float(-(1.0 + seconds / SERVICE_REWARD_S))


@compiled
def act(net: Network, k: Record, world: World, c: int, n: int, action: int) -> float:
    """Apply the action of a bus and return its reward."""
    bus = world.buses[c, n]
    bus.stop = net.route_stop[net.route_first[bus.route] + bus.place]
    if action == WAIT:
        _pass_time(bus, WAIT_S)
        world.days[c].waits += 1
        return WAIT_REWARD
    if action == MOVE:
        return _move(net, k, world, c, bus)
    return _serve(net, world, c, bus)
