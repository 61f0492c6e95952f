"""Names, units and scales of the numbers that `kernel.observe` fills."""

from headway.contracts import ObservationFeature
from headway_envs.bus_published.kernel.layout import DAY_S, LONGEST_LINK_S
from headway_envs.bus_published.prepared import Prepared


def features(prepared: Prepared) -> tuple[ObservationFeature, ...]:
    """Return the features of an observation, in order."""
    [settings] = prepared.settings
    demand, stop = float(settings["demand_unit"]), float(settings["stop_unit"])
    return (
        ObservationFeature("clock", "the bus's clock, from midnight; at most 1", "s", DAY_S),
        ObservationFeature("occupancy", "share of the capacity"),
        ObservationFeature(
            "link_time", "time of the next link on the way out; at most 1", "s", LONGEST_LINK_S
        ),
        ObservationFeature("demand", "demand at the next stop on the way out", "boardings per day", demand),
        ObservationFeature("uptime", "1: fresh, 0: worn"),
        ObservationFeature("in_order", "always 1"),
        ObservationFeature("stop", "number of this stop; after service, of the centre", scale=stop),
        ObservationFeature("next_stop", "number of the next stop on the way out", scale=stop),
    )
