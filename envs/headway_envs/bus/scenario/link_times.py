"""Link times: of synthetic scenarios, from fitted parameters; of others, from observed drives."""

from collections import Counter
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from headway_envs.bus.scenario.fitted import LINK_S_LOG, MEAN_SPEED_KMH, SPEED_KMH, WITHIN_HOUR_SD
from headway_envs.bus.scenario.measures import MAX_SPEED_MPS, TIMED_HOURS
from headway_envs.bus.scenario.tables import Columns, stack

if TYPE_CHECKING:
    import pandas as pd

_MIN_LINK_S = 8.0
MAX_LINK_S = 1800.0
"""Largest plausible time between stops, s. Longer times are due to position errors or to breaks."""
_MODEL_WEIGHT = 4.0
"""Weight of the model of link and hour, in observed drives."""
_SD_WEIGHT = 8.0
"""Weight of the fitted spread, in observed drives."""
_MAX_SD = 0.8
"""Largest sd of the log of link times that is written."""
_MIN_OBSERVED_S = 5.0


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


def plausible_drives(
    legs: "pd.DataFrame", metres: NDArray[np.float64], counted: Counter[str]
) -> "pd.DataFrame":
    """Return the drives (link, hour, s) of plausible duration, with hours limited to `TIMED_HOURS`.

    `metres`: lengths of the links. The others are counted.
    """
    counted["link times of 0 s, not used"] += int((legs["s"] <= 0).sum())
    counted[f"link times above {MAX_LINK_S:g} s, not used"] += int((legs["s"] > MAX_LINK_S).sum())
    fast = (legs["s"] > 0) & (metres[legs["link"]] / legs["s"].clip(lower=0.1) > MAX_SPEED_MPS)
    counted["link times faster than 90 km/h, not used"] += int(fast.sum())
    kept: pd.DataFrame = legs[(legs["s"] > 0) & (legs["s"] <= MAX_LINK_S) & ~fast]
    return kept.assign(hour=kept["hour"].clip(TIMED_HOURS[0], TIMED_HOURS[-1]).astype(np.int64))


def smoothed_link_times(
    legs: "pd.DataFrame", metres: NDArray[np.float64], counted: Counter[str]
) -> "pd.DataFrame":
    """Return one row per link and hour of plausible drives: link, hour, n, log_sigma and mean_s.

    The model is the link's mean times a factor of the hour; a link without drives takes the fitted time for
    its length. mean_s is the mean of the n observed drives and of the model, which counts as four drives.
    """
    import pandas as pd

    intercept, slope, _ = LINK_S_LOG
    count = np.bincount(legs["link"], minlength=len(metres))
    fitted = np.exp(intercept + slope * np.log(np.maximum(metres, 1.0)))
    total = np.bincount(legs["link"], legs["s"], minlength=len(metres))
    base = (total + _MODEL_WEIGHT * fitted) / (count + _MODEL_WEIGHT)
    counted["links never driven, times by length"] += int((count == 0).sum())
    hour = legs["hour"].to_numpy() - TIMED_HOURS[0]
    observed = np.bincount(hour, legs["s"], minlength=len(TIMED_HOURS)) + _MODEL_WEIGHT * base.mean()
    expected = np.bincount(hour, base[legs["link"]], minlength=len(TIMED_HOURS)) + _MODEL_WEIGHT * base.mean()
    model = np.outer(base, observed / expected)
    cell = legs["link"].to_numpy() * len(TIMED_HOURS) + hour
    n = np.bincount(cell, minlength=model.size).reshape(model.shape)
    sums = np.bincount(cell, legs["s"], minlength=model.size).reshape(model.shape)
    mean = np.maximum((sums + _MODEL_WEIGHT * model) / (n + _MODEL_WEIGHT), _MIN_OBSERVED_S)
    logs = np.log(legs["s"].to_numpy())
    middle = np.bincount(cell, logs, minlength=model.size) / np.maximum(n.ravel(), 1)
    squares = np.bincount(legs["link"], (logs - middle[cell]) ** 2, minlength=len(metres))
    free = np.maximum(count - (n > 0).sum(axis=1), 0)
    sigma = np.sqrt((squares + _SD_WEIGHT * WITHIN_HOUR_SD**2) / (free + _SD_WEIGHT))
    return pd.DataFrame(
        {
            "link": np.repeat(np.arange(len(metres)), len(TIMED_HOURS)),
            "hour": np.tile(TIMED_HOURS, len(metres)),
            "n": n.ravel(),
            "log_sigma": np.repeat(np.minimum(sigma, _MAX_SD), len(TIMED_HOURS)),
            "mean_s": mean.ravel(),
        }
    )
