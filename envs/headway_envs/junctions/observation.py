"""Names, units and scales of the numbers that the kernel observes."""

from headway.contracts import ObservationFeature
from headway_envs.junctions.kernel import SIGHT_M

_SHOWN = (
    ("crossing_end", "the last of the platoon whose head has passed; none"),
    ("head", "the first AV that has not passed; none"),
    ("end", "the last of its platoon; none"),
)


def features(approaches: int, speed_limit: float) -> tuple[ObservationFeature, ...]:
    """Return the features of an observation with K = `approaches`: all distances, then all speeds."""
    who = [("own", "the AV"), ("platoon_end", "the last of its platoon")]
    none: list[tuple[str, str]] = [("", ""), ("", "")]
    for number in range(1, approaches):
        for name, meaning in _SHOWN:
            who.append((f"approach_{number}_{name}", f"approach {number} clockwise: {meaning}"))
            none.append(("0 m", "the limit") if name == "crossing_end" else ("100 m", "0"))
    return (
        *(
            ObservationFeature(
                f"{name}_distance",
                f"distance to the junction, 0 to 100 m, of {meaning}{f': {far}' if far else ''}, minus 50 m",
                "m",
                SIGHT_M / 2,
            )
            for (name, meaning), (far, _) in zip(who, none, strict=True)
        ),
        *(
            ObservationFeature(
                f"{name}_speed",
                f"speed, up to the limit, of {meaning}{f': {slow}' if slow else ''}, minus half the limit",
                "m/s",
                speed_limit / 2,
            )
            for (name, meaning), (_, slow) in zip(who, none, strict=True)
        ),
    )
