"""Link times of synthetic scenarios, from fitted parameters."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from headway_envs.bus.scenario.fitted import LINK_S_LOG, MEAN_SPEED_KMH, SPEED_KMH, WITHIN_HOUR_SD
from headway_envs.bus.scenario.measures import TIMED_HOURS
from headway_envs.bus.scenario.tables import Columns, stack

_MIN_LINK_S = 8.0


def fitted_link_times(rng: np.random.Generator, links: NDArray[np.int64], metres: NDArray[Any]) -> Columns:
    """Return the table link_times of links of the given lengths, m."""
    intercept, slope, sd = LINK_S_LOG
    base = np.exp(intercept + slope * np.log(metres) + rng.normal(0.0, sd, len(metres)))
    days = []
    for day, (hours, speeds) in SPEED_KMH.items():
        factor = MEAN_SPEED_KMH / np.interp(TIMED_HOURS, hours, speeds)
        rows = len(links) * len(TIMED_HOURS)
        days.append(
            {
                "link": np.repeat(links, len(TIMED_HOURS)),
                "hour": np.tile(TIMED_HOURS, len(links)),
                "log_sigma": np.full(rows, WITHIN_HOUR_SD),
                "mean_s": np.maximum(np.outer(base, factor), _MIN_LINK_S).ravel(),
                "daytype": np.full(rows, day),
            }
        )
    return stack(days)
