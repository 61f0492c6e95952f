"""Names, units and scales of the numbers that the kernel observes."""

from headway.contracts import ObservationFeature
from headway_envs.junctions.kernel import SIGHT_M

_SHOWN = (
    ("crossing_end", "last of the platoon whose head has passed", ("0 m", "the limit")),
    ("head", "first AV that has not passed", ("100 m", "0 m/s")),
    ("end", "last of the platoon of the first AV that has not passed", ("100 m", "0 m/s")),
)
"""Vehicles of another approach: name, meaning, and distance and speed shown where there is none."""


def features(approaches: int, speed_limit: float) -> tuple[ObservationFeature, ...]:
    """Return the features of an observation with K = `approaches`: all distances, then all speeds."""
    shown = [("own", "the AV itself", ("", "")), ("platoon_end", "last of its platoon", ("", ""))]
    for number in range(1, approaches):
        for name, meaning, none in _SHOWN:
            shown.append((f"approach_{number}_{name}", f"approach {number} clockwise, {meaning}", none))
    quantities = (
        (
            "distance",
            f"distance to the junction, 0 to {SIGHT_M:.0f} m, minus {SIGHT_M / 2:.0f} m",
            "m",
            SIGHT_M,
        ),
        ("speed", "speed, 0 to the limit, minus half the limit", "m/s", speed_limit),
    )
    return tuple(
        ObservationFeature(
            f"{name}_{quantity}",
            f"{meaning}: {what}" + (f"; none: as at {none[place]}" if none[place] else ""),
            unit,
            scale / 2,
        )
        for place, (quantity, what, unit, scale) in enumerate(quantities)
        for name, meaning, none in shown
    )
