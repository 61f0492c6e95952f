"""Statistics of a day: headways, trips and loads.

Headways are measured as is usual for frequent service: relative to the mean of a two-hour window, per line,
direction and stop, from 6 to 20 h, in windows of at least four headways. Peaks of the timetable thus do not
count as irregularity.
"""

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from headway.contracts import HeadwayError

Floats = NDArray[np.float64]

FIFTHS = 5
"""Number of parts of a route in which headways are measured separately."""
SPEED_HOURS = (5, 7, 10, 17, 22)
"""Hours of departure for which speeds are measured."""
WINDOW_S = 7200.0
"""Width of a window, s."""
MIN_HEADWAYS = 4
"""Minimum number of headways, or of trips, for a window to be used."""
_FROM_S, _TO_S = 6 * 3600.0, 20 * 3600.0
BUNCHED = 0.25
"""Headways below this share of the mean count as bunched."""


def cv_name(fifth: int) -> str:
    """Return the name of the headway CV in one fifth of the route; `fifth` is 0 to 4."""
    return f"headway CV, fifth {fifth + 1}"


def bunched_name(fifth: int) -> str:
    """Return the name of the share of bunched headways in one fifth of the route; `fifth` is 0 to 4."""
    return f"bunched share, fifth {fifth + 1}"


def speed_name(hour: int) -> str:
    """Return the name of the mean speed of trips that leave in an hour."""
    return f"speed {hour:02d} h, km/h"


FIRST_CV, LAST_CV = "headway CV, first call", "headway CV, last call"
TRIP_MEAN, TRIP_P5, TRIP_P50, TRIP_P95 = "trip mean, min", "trip p5, min", "trip p50, min", "trip p95, min"
TRIP_SPREAD = "trip time sd within 2 h, %"
DWELL = "dwell mean, s"
BOARDINGS = "boardings per day"
LOAD_P50, LOAD_P95 = "load p50", "load p95"
RIDE = "ride length, stops"
RESPONSE = "slope of boardings on the headway"


def headway_statistics(calls: pd.DataFrame) -> dict[str, float]:
    """Return the headway CV and the bunched share by fifth of the route."""
    rows = _relative_headways(calls)
    fifth = (rows["seq0"] * FIFTHS // rows["calls"]).to_numpy(np.int64)
    found = {}
    for place in range(FIFTHS):
        own = rows[fifth == place]
        found[cv_name(place)] = _cv(own)
        found[bunched_name(place)] = float((own["ratio"] < BUNCHED).mean()) if len(own) else np.nan
    return found


def dwell_statistics(calls: pd.DataFrame) -> dict[str, float]:
    """Return the mean dwell between the first and the last call; NaN if arrivals equal all departures."""
    dwell = (calls["left"] - calls["arrived"]).dropna()
    return {DWELL: float(dwell.mean()) if dwell.any() else np.nan}


def finished_trip_statistics(trips: pd.DataFrame) -> dict[str, float]:
    """Return statistics of durations, their spread, hourly speeds, and headway CVs at both ends.

    `trips`: one row per finished trip: line, dir, pattern, begin and end (stops), dep and arr (s), km. Speeds
    are by hour of departure. The spread is the sd of the log of the duration about the mean of its pattern
    and window. Raises HeadwayError if there are no trips.
    """
    if trips.empty:
        raise HeadwayError(
            "no trip was finished within the day: give a timetable whose arr_s are after dep_s"
        )
    minutes = (trips["arr"] - trips["dep"]).to_numpy(np.float64) / 60.0
    found = {TRIP_MEAN: float(minutes.mean())}
    for name, share in ((TRIP_P5, 0.05), (TRIP_P50, 0.5), (TRIP_P95, 0.95)):
        found[name] = float(np.quantile(minutes, share))
    logs = pd.Series(np.log(minutes), index=trips.index)
    groups = logs.groupby([trips["pattern"], trips["dep"] // WINDOW_S])
    count = groups.transform("size")
    inside = count >= MIN_HEADWAYS
    away = (logs - groups.transform("mean"))[inside]
    free = float((1.0 - 1.0 / count[inside]).sum())
    found[TRIP_SPREAD] = 100.0 * float(np.sqrt((away**2).sum() / free)) if free > 0 else np.nan
    for hour in SPEED_HOURS:
        own = (trips["dep"] // 3600 == hour).to_numpy()
        found[speed_name(hour)] = (
            float(trips["km"][own].sum() / (minutes[own].sum() / 60.0)) if any(own) else np.nan
        )
    for name, stop, time in ((FIRST_CV, "begin", "dep"), (LAST_CV, "end", "arr")):
        ends = trips.assign(stop=trips[stop], visit=0, time=trips[time])
        found[name] = _cv(_relative_headways(ends))
    return found


def passenger_statistics(calls: pd.DataFrame) -> dict[str, float]:
    """Return statistics of loads, boardings, ride length and the response of boardings to the headway.

    Loads are quantiles at departure. Ride length is passengers aboard, summed over calls, per boarding. The
    response is the slope of the boardings at a call, relative to the mean of their window, on the relative
    headway.
    """
    load = calls["load"].to_numpy(np.float64)
    load = load[~np.isnan(load)]
    boarded = float(calls["boarded"].sum())
    rows = _relative_headways(calls)
    mean = rows.groupby("window")["boarded"].transform("mean").to_numpy(np.float64)
    some = mean > 0
    relative = rows["boarded"].to_numpy(np.float64)[some] / mean[some]
    ratio = rows["ratio"].to_numpy(np.float64)[some]
    # Windows are weighted by their passengers, because those with few are mostly noise.
    weight = mean[some]
    about = (ratio - 1.0) * weight
    return {
        BOARDINGS: boarded,
        LOAD_P50: float(np.quantile(load, 0.5)) if len(load) else np.nan,
        LOAD_P95: float(np.quantile(load, 0.95)) if len(load) else np.nan,
        RIDE: float(load.sum() / boarded) if boarded > 0 else np.nan,
        RESPONSE: float((about * (relative - 1.0)).sum() / (about * (ratio - 1.0)).sum())
        if len(ratio)
        else np.nan,
    }


def finished_trips(calls: pd.DataFrame, km: "pd.Series[float]") -> pd.DataFrame:
    """Return the finished trips of a day's calls, as `finished_trip_statistics` takes them.

    `km`: by pattern.
    """
    first = calls[calls["seq0"] == 0].set_index("trip")
    last = calls[calls["seq0"] == calls["calls"] - 1].set_index("trip")
    trips = first.loc[first.index.isin(last.index), ["line", "dir", "pattern"]].copy()
    trips["begin"], trips["end"] = first["stop"], last["stop"]
    trips["dep"], trips["arr"] = first["left"], last["arrived"]
    trips["km"] = km.reindex(trips["pattern"]).to_numpy()
    return trips.reset_index()


def _relative_headways(calls: pd.DataFrame) -> pd.DataFrame:
    """Return the calls with a headway in a window of at least `MIN_HEADWAYS`.

    Added columns: `ratio` (headway over the mean of the window), `window` (its number) and `count` (number of
    its headways).
    """
    place = calls.groupby(["line", "dir", "stop", "visit"], sort=False).ngroup().to_numpy()
    time = calls["time"].to_numpy(np.float64)
    order = np.lexsort((time, place))
    rows = calls.iloc[order]
    place, time = place[order], time[order]
    headway = np.diff(time, prepend=np.nan)
    inside = np.diff(place, prepend=-1) == 0
    inside &= (time >= _FROM_S) & (time < _TO_S)
    rows, headway = rows[inside], headway[inside]
    windows = int(_TO_S // WINDOW_S) + 1
    _, window = np.unique(
        place[inside] * windows + (time[inside] // WINDOW_S).astype(np.int64), return_inverse=True
    )
    count = np.bincount(window)[window]
    mean = np.bincount(window, headway)[window] / count
    kept = (count >= MIN_HEADWAYS) & (mean > 0)
    kept_rows: pd.DataFrame = rows[kept]
    return kept_rows.assign(ratio=headway[kept] / mean[kept], window=window[kept], count=count[kept])


def _cv(rows: pd.DataFrame) -> float:
    """Return the root mean square deviation of `ratio` from 1, corrected for the bias of small windows."""
    if rows.empty:
        return np.nan
    count = rows["count"].to_numpy(np.float64)
    square = (rows["ratio"].to_numpy(np.float64) - 1.0) ** 2
    return float(np.sqrt((square * count / (count - 1.0)).mean()))
