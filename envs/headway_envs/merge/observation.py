"""Names, units and scales of the numbers that `kernel.observe` fills."""

from headway.contracts import ObservationFeature
from headway_envs.merge.kernel.layout import OBSERVED_VEHICLES
from headway_envs.merge.prepared import Prepared

_AXES = (("x", "along the highway", 150.0), ("y", "to the right", 12.0))


def features(prepared: Prepared) -> tuple[ObservationFeature, ...]:
    """Return the features of an observation, in order: of the CAV, then of the vehicles nearest along the
    road and within 180 m."""
    near = [
        feature
        for number in range(1, OBSERVED_VEHICLES + 1)
        for feature in _vehicle(f"near_{number}_", " minus the CAV's; 0 without a vehicle")
    ]
    return (*_vehicle("", ""), *near)


def _vehicle(prefix: str, relative: str) -> tuple[ObservationFeature, ...]:
    return (
        ObservationFeature(f"{prefix}present", "1: there is a vehicle" if prefix else "always 1"),
        *(
            ObservationFeature(f"{prefix}{axis}", f"position {way}{relative}", "m", scale)
            for axis, way, scale in _AXES
        ),
        *(
            ObservationFeature(f"{prefix}speed_{axis}", f"velocity {way}{relative}", "m/s", 45.0)
            for axis, way, _ in _AXES
        ),
    )
