"""Link times of SUNT: means and spreads by hour, completed where there are few observations."""

from collections import Counter
from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from headway_envs.bus.scenario.fitted import LINK_S_LOG, WITHIN_HOUR_SD
from headway_envs.bus.scenario.measures import MAX_SPEED_MPS, TIMED_HOURS
from headway_envs.bus.scenario.sunt.records import Day

MAX_LINK_S = 1800.0
"""Largest plausible time between stops, s. Longer times are faults of the positions, or breaks."""
_MODEL_WEIGHT = 4.0
"""Weight of the model of link and hour, in observed drives."""
_SD_WEIGHT = 8.0
"""Weight of the fitted spread, in observed drives."""
_MAX_SD = 0.8
"""Largest sd of the log of link times that is written."""
_MIN_LINK_S = 5.0


def link_times(
    network: Mapping[str, pd.DataFrame], days: Sequence[Day], counted: Counter[str]
) -> pd.DataFrame:
    """Return the table link_times for the day types of `days`."""
    links = network["links"]
    stop_id = network["stops"].set_index("stop")["stop_id"]
    ends = pd.MultiIndex.from_arrays(
        [stop_id.reindex(links["from_stop"]).to_numpy(), stop_id.reindex(links["to_stop"]).to_numpy()]
    )
    metres = links["leg_m"].to_numpy(np.float64)
    frames = []
    for kind in ("weekday", "sunday"):
        own = [day.calls for day in days if day.day_type == kind]
        if own:
            legs = pd.concat([_drives(calls, ends, metres, counted) for calls in own], ignore_index=True)
            frames.append(_smoothed_times(legs, metres, counted).assign(daytype=kind))
    return pd.concat(frames, ignore_index=True)


def _drives(
    calls: pd.DataFrame, ends: pd.MultiIndex, metres: NDArray[np.float64], counted: Counter[str]
) -> pd.DataFrame:
    """Return link, hour and duration (s) of each plausible drive from one stop to the next."""
    stop, time = calls["stop_id"].to_numpy(), calls["time"].to_numpy()
    following = (np.diff(calls["trip"]) == 0) & (np.diff(calls["seq"]) == 1)
    pairs = pd.MultiIndex.from_arrays([stop[:-1][following], stop[1:][following]])
    link = ends.get_indexer(pairs)
    legs = pd.DataFrame({"link": link, "hour": time[:-1][following] // 3600, "s": np.diff(time)[following]})
    legs = legs[legs["link"] >= 0]
    counted["link times of 0 s, not used"] += int((legs["s"] <= 0).sum())
    counted[f"link times above {MAX_LINK_S:g} s, not used"] += int((legs["s"] > MAX_LINK_S).sum())
    fast = (legs["s"] > 0) & (metres[legs["link"]] / legs["s"].clip(lower=0.1) > MAX_SPEED_MPS)
    counted["link times faster than 90 km/h, not used"] += int(fast.sum())
    kept: pd.DataFrame = legs[(legs["s"] > 0) & (legs["s"] <= MAX_LINK_S) & ~fast]
    return kept.assign(hour=kept["hour"].clip(TIMED_HOURS[0], TIMED_HOURS[-1]).astype(np.int64))


def _smoothed_times(legs: pd.DataFrame, metres: NDArray[np.float64], counted: Counter[str]) -> pd.DataFrame:
    """Return one row per link and hour: n, mean_s and log_sigma.

    The model is the link's mean times a factor of the hour; a link without drives takes the fitted time for
    its length. mean_s is the mean of the n observed drives and of the model, which counts as four drives.
    """
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
    mean = np.maximum((sums + _MODEL_WEIGHT * model) / (n + _MODEL_WEIGHT), _MIN_LINK_S)
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
