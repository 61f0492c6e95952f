"""Names, units and scales of the numbers that `kernel.observe` fills."""

from headway.contracts import ObservationFeature
from headway_envs.bus.prepared import Prepared

_PAPER = ("running_time", "expected_boardings", "load", "uptime")
_TARGETS = "target headways"
_OF_LINES = (
    ObservationFeature("trip_time", "nominal time of the line's longest trip; at most 5", "s", 3600.0),
    ObservationFeature("target", "target headway; at most 5", "s", 1800.0),
    ObservationFeature(
        "to_centre", "driving time from this stop to the nearest service centre; at most 5", "s", 1800.0
    ),
    ObservationFeature(
        "extra_to_centre",
        "its excess over the shortest such time from the line's terminals; at most 5",
        "s",
        300.0,
    ),
)


def features(prepared: Prepared) -> tuple[ObservationFeature, ...]:
    """Return the features of the configured observation, in order."""
    described = _control(prepared)
    match prepared.config.observation:
        case "network":
            return (*described, *_OF_LINES)
        case "control":
            return described
        case "published":
            return described[:8]
    by_name = {feature.name: feature for feature in described}
    return tuple(by_name[name] for name in _PAPER)


def _control(prepared: Prepared) -> tuple[ObservationFeature, ...]:
    config = prepared.config
    day_s = 3600.0 * (config.end_hour - config.start_hour)
    return (
        ObservationFeature("time", "time since the start of the service day", "s", day_s),
        ObservationFeature("load", "passengers aboard", "passengers", float(config.capacity)),
        ObservationFeature("running_time", "mean running time to the next stop; at most 1", "s", 300.0),
        ObservationFeature(
            "expected_boardings",
            "boardings expected at the next stop within a target headway; at most 1",
            "passengers",
            20.0,
        ),
        ObservationFeature("uptime", "1: fresh, 0: worn"),
        ObservationFeature("in_order", "1: not broken down, fuel and uptime not below the warning level"),
        ObservationFeature("stop", "position of this stop on the route, from 0 to 1"),
        ObservationFeature("next_stop", "position of the next stop on the route, from 0 to 1"),
        ObservationFeature("fuel", "fuel in the tank", "units of fuel", float(config.upkeep.fuel_capacity)),
        ObservationFeature("spacing_ahead", "spacing to the bus ahead minus 1; at most 2, 0: none", _TARGETS),
        ObservationFeature(
            "spacing_behind", "spacing to the bus behind minus 1; at most 2, 0: none", _TARGETS
        ),
        ObservationFeature("spacing_difference", "half the spacing ahead minus half that behind", _TARGETS),
        ObservationFeature("last_headway", "headway at the last departure minus 1; -1 to 2", _TARGETS),
        ObservationFeature("lateness", "delay against the timetable; -2 to 2", "s", 1800.0),
        ObservationFeature("progress", "share of the route's nominal time that lies behind"),
        ObservationFeature(
            "waiting",
            "passengers expected to wait there at the bus's next event; at most 3",
            "passengers",
            20.0,
        ),
        ObservationFeature("at_stop", "1: at a stop"),
        ObservationFeature("at_terminal", "1: at a terminal"),
        ObservationFeature("out_of_service", "1: broken down or at the service centre"),
        ObservationFeature("day_sine", "sine of the time of day as an angle"),
        ObservationFeature("day_cosine", "cosine of the time of day as an angle"),
        ObservationFeature("held", "time held at this stop so far; at most 3", "s", 300.0),
        ObservationFeature(
            "until_event", "time until the bus's next event; at most 1", "s", 5.0 * config.tick_s
        ),
        ObservationFeature("event_headway", "headway at that event minus 1; -1 to 2", _TARGETS),
        ObservationFeature(
            "until_departure", "time until the scheduled departure, at a terminal; -2 to 2", "s", 600.0
        ),
        ObservationFeature("pattern", "number of the route pattern within the line"),
        ObservationFeature(
            "work_left", "planned driving time until the next stay at the depot", "s", 43200.0
        ),
        ObservationFeature("line_service", "service q of the line, a term of the reward"),
        ObservationFeature("line_regularity", "regularity c of the line, a term of the reward"),
    )
