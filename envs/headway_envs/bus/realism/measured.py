"""Statistics measured in Salvador, and the tolerances of the comparison.

Source of every number: SUNT, Salvador Urban Network Transportation (LabIA-UFBA), CC BY 4.0, doi
10.17632/85fdtx3kr5.1. Headways: all lines on Monday 2024-08-26 and Sunday 2024-09-15. The records of that
Monday have no fares: loads, ride length and the response of boardings to the headway were measured on one
operator's lines (half the city) on 2024-06-04 and 05, and on Sundays.
"""

from collections.abc import Mapping
from dataclasses import dataclass

from headway_envs.bus.realism.trip_statistics import (
    BOARDINGS,
    DWELL,
    FIFTHS,
    FIRST_CV,
    LAST_CV,
    LOAD_P50,
    LOAD_P95,
    RESPONSE,
    RIDE,
    SPEED_HOURS,
    TRIP_MEAN,
    TRIP_P5,
    TRIP_P50,
    TRIP_P95,
    TRIP_SPREAD,
    bunched_name,
    cv_name,
    speed_name,
)


def _by_fifth(cv: tuple[float, ...], bunched: tuple[float, ...]) -> dict[str, float]:
    """Return headway CVs and bunched shares by name, for each fifth of the route."""
    found = {}
    for fifth in range(FIFTHS):
        found[cv_name(fifth)] = cv[fifth]
        found[bunched_name(fifth)] = bunched[fifth]
    return found


WHOLE_CITY: Mapping[str, Mapping[str, float]] = {
    "weekday": {
        **_by_fifth((0.54, 0.59, 0.64, 0.68, 0.71), (0.066, 0.087, 0.107, 0.122, 0.134)),
        LOAD_P50: 13.7,
        LOAD_P95: 57.0,
        RIDE: 13.0,
        RESPONSE: 0.47,
    },
    "sunday": {
        **_by_fifth((0.48, 0.51, 0.54, 0.57, 0.59), (0.052, 0.061, 0.073, 0.086, 0.101)),
        LOAD_P50: 11.6,
        LOAD_P95: 44.0,
        RIDE: 13.5,
        RESPONSE: 0.47,
    },
}
"""Statistics over all lines, by day type and name as in `trip_statistics`."""

CITY_LINES: Mapping[str, int] = {"weekday": 382, "sunday": 253}
"""Number of lines with trips, by day type."""
NEARLY_ALL = 0.9
"""Share of the city's lines that a scenario needs to be judged by the city's statistics."""


@dataclass(frozen=True)
class Tolerance:
    """Largest accepted difference of a simulated statistic: absolute, or as a share of the measured value."""

    size: float
    share: bool = False
    """Whether `size` is a share of the measured value."""

    def of(self, measured: float) -> float:
        """Return the tolerance in the unit of the statistic."""
        return self.size * abs(measured) if self.share else self.size


TOLERANCES: Mapping[str, Tolerance] = {
    FIRST_CV: Tolerance(0.01),
    **{cv_name(fifth): Tolerance(0.05) for fifth in range(FIFTHS)},
    LAST_CV: Tolerance(0.05),
    **{bunched_name(fifth): Tolerance(0.02) for fifth in range(FIFTHS)},
    TRIP_MEAN: Tolerance(0.05, share=True),
    TRIP_P5: Tolerance(0.10, share=True),
    TRIP_P50: Tolerance(0.10, share=True),
    TRIP_P95: Tolerance(0.10, share=True),
    TRIP_SPREAD: Tolerance(0.15, share=True),
    **{speed_name(hour): Tolerance(0.10, share=True) for hour in SPEED_HOURS},
    DWELL: Tolerance(0.15, share=True),
    BOARDINGS: Tolerance(0.05, share=True),
    LOAD_P50: Tolerance(0.15, share=True),
    LOAD_P95: Tolerance(0.15, share=True),
    RIDE: Tolerance(1.0),
    RESPONSE: Tolerance(0.10),
}
"""Tolerance of each statistic, chosen by judgement. At the first call a replay repeats the data, so hardly
any difference is accepted; the others are near the difference between two measured days of one day type."""
