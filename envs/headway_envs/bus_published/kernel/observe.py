"""Observations of the buses."""

from headway_envs.bus_published.kernel.compiled import compiled
from headway_envs.bus_published.kernel.layout import DAY_S, LONGEST_LINK_S, Network, Outputs, Record, World


@compiled
def observe(net: Network, k: Record, world: World, outputs: Outputs, c: int) -> None:
    """Fill the eight observed features of each bus of copy c.

    They are: time of day, occupancy, time of the next link, demand at the next stop, uptime, a constant 1
    (maintenance in order), this stop and the next stop. The next stop is always that of the way out, also on
    the way back. After service, this stop is the centre.
    """
    for n in range(world.buses.shape[1]):
        bus, row = world.buses[c, n], outputs.observations[c, n]
        place, last = net.route_first[bus.route] + bus.place, net.route_first[bus.route + 1] - 1
        # At the last stop, which has no next one, use the observed stop and the mean link time instead.
        ahead = bus.stop
        seconds = net.travel_s[net.route_stop[place], net.route_stop[place]]
        if place < last:
            ahead = net.route_stop[place + 1]
            seconds = net.travel_s[bus.stop, ahead]
        row[0] = min(bus.clock / DAY_S, 1.0)
        row[1] = bus.occupancy
        row[2] = min(seconds / LONGEST_LINK_S, 1.0)
        row[3] = net.demand[ahead] / k.demand_unit
        row[4] = bus.uptime
        row[5] = 1.0
        row[6] = bus.stop / k.stop_unit
        row[7] = ahead / k.stop_unit
