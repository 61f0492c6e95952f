"""Raw files of SUNT: trip records by day, counts by stop, and coordinates of stops.

Irregularities are corrected and counted.
"""

import datetime as dt
import re
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import pandas as pd

from headway.contracts import HeadwayError

DayType = Literal["weekday", "saturday", "sunday"]

HOLIDAYS = (
    *((2024, 3, 29), (2024, 5, 1), (2024, 5, 30), (2024, 6, 24), (2024, 7, 2), (2024, 9, 7), (2024, 10, 12)),
    *((2024, 11, 2), (2024, 11, 15), (2024, 11, 20), (2024, 12, 8), (2024, 12, 25), (2025, 1, 1)),
)
"""Holidays of Brazil, Bahia and Salvador within the dataset's period, with a timetable like a Sunday's."""
FARES_MISSING = 1.0
"""Boardings per trip below which a day's fares are taken to be missing (2024-08-26: 0.03)."""
ALIGHTINGS_MISSING = 0.9
"""Alightings per boarding below which a day's alightings are taken to be raw counts, although its boardings
are expanded (until April 2024)."""
UNPHYSICAL_LOAD = 150.0
"""Largest plausible load of a bus, passengers."""
TRIP_KEYS = ("vehicle", "trip_id", "start_trip")
"""Columns that identify a trip of a day."""
_COLUMNS = (
    *("route_short_name", "register_code", "direction_id", "pt_sequence", "stop_id", "vehicle", "trip_id"),
    *("start_trip", "stop_time", "n-boardings", "n-alighting", "lag_loading", "loading"),
)
_OD = re.compile(r"od-(\d{4})-(\d{2})-(\d{2})\.parquet")
_NODES = re.compile(r"node_temporal_features_(\d{2})-(\d{2})-(\d{4})\.parquet")


@dataclass(frozen=True)
class Day:
    """Calls of one day, one trip after the other, in driving order.

    Columns of `calls`: line, reg, dir, seq (from 1), stop_id, trip (number), vehicle, time (s after midnight
    of the service day), board, alight, load_before.
    """

    date: dt.date
    calls: pd.DataFrame
    fares: bool
    """Whether boardings were counted."""
    alightings: bool
    """Whether alightings were expanded in the same way as boardings."""

    @property
    def day_type(self) -> DayType:
        return day_type(self.date)

    @property
    def trips(self) -> int:
        """Number of trips."""
        return int(self.calls["trip"].nunique())


def day_type(date: dt.date) -> DayType:
    """Return the day type of the timetable on a date."""
    if date.weekday() == 6 or (date.year, date.month, date.day) in HOLIDAYS:
        return "sunday"
    return "saturday" if date.weekday() == 5 else "weekday"


def find_days(raw: Path) -> dict[dt.date, Path]:
    """Return the files od-YYYY-MM-DD.parquet anywhere below `raw`, by date.

    Raises HeadwayError if there are none.
    """
    if not raw.is_dir():
        raise HeadwayError(f"RAW: {raw} is not a folder; give the one that holds SUNT's files od-*.parquet")
    found = {
        dt.date(*(int(part) for part in match.groups())): file
        for file in sorted(raw.rglob("od-*.parquet"))
        if (match := _OD.fullmatch(file.name))
    }
    if not found and (raw / "pattern_stops.parquet").is_file():
        raise HeadwayError(f"RAW: {raw} is a scenario already; use it as it is: env.args.scenario={raw}")
    if not found:
        raise HeadwayError(f"RAW: there is no file od-YYYY-MM-DD.parquet below {raw}")
    return found


def read_day(file: Path, date: dt.date, counted: Counter[str]) -> Day:
    """Read, correct and check the trip records of one day.

    Raises HeadwayError for missing columns and for files without a usable trip.
    """
    frame = _parquet(file, _COLUMNS)
    frame = frame.astype(dict.fromkeys(("route_short_name", "direction_id", "vehicle", "trip_id"), "str"))
    midnight = pd.Timestamp(date)
    # Some files store times as text.
    time = (pd.to_datetime(frame["stop_time"]) - midnight).dt.total_seconds()
    calls = pd.DataFrame(
        {
            "line": frame["route_short_name"],
            "reg": frame["register_code"].astype(str),
            "dir": frame["direction_id"],
            "seq": frame["pt_sequence"].astype(np.int64),
            "stop_id": frame["stop_id"].astype(str),
            "trip": frame.groupby(list(TRIP_KEYS), sort=False).ngroup(),
            "vehicle": frame["vehicle"],
            "time": time,
            "board": frame["n-boardings"].astype(np.float64),
            "alight": frame["n-alighting"].astype(np.float64),
            "load_before": frame["lag_loading"].astype(np.float64),
        }
    )
    blank = calls["time"].isna()
    counted["calls without a time, left out"] += int(blank.sum())
    loads = frame["loading"].to_numpy(np.float64)
    counted["loads below 0, not used"] += int((loads < 0).sum())
    counted[f"loads above {UNPHYSICAL_LOAD:g}, not used"] += int((loads > UNPHYSICAL_LOAD).sum())
    impossible = ~calls["load_before"].between(0.0, UNPHYSICAL_LOAD)
    calls.loc[impossible, "load_before"] = np.nan
    calls = calls[~blank].sort_values(["trip", "seq", "time"], kind="stable")
    twice = calls.duplicated(["trip", "seq"])
    counted["calls given twice, the second left out"] += int(twice.sum())
    calls = calls[~twice]
    for column, name in (("board", "boardings"), ("alight", "alightings")):
        values = calls[column].to_numpy()
        counted[f"{name} blank, taken as 0"] += int(np.isnan(values).sum())
        counted[f"{name} infinite, taken as 0"] += int(np.isinf(values).sum())
        counted[f"{name} below 0, taken as 0"] += int((values < 0).sum())
        values = np.where(np.isfinite(values), np.maximum(values, 0.0), 0.0)
        counted[f"{name} not whole (expanded), kept"] += int((values % 1 != 0).sum())
        calls[column] = values
    before = calls.groupby("trip")["time"].cummax()
    counted["times before the previous call's, set to it"] += int((calls["time"] < before).sum())
    calls["time"] = before
    few = calls.groupby("trip")["seq"].transform("size") < 2
    counted["trips of one call, left out"] += int(calls.loc[few, "trip"].nunique())
    ends = calls.groupby("trip")["time"].agg(["first", "last"])
    still = calls["trip"].map(ends["first"] == ends["last"]) & ~few
    counted["trips that end when they begin, left out"] += int(calls.loc[still, "trip"].nunique())
    calls = calls[~few & ~still].reset_index(drop=True)
    if calls.empty:
        raise HeadwayError(f"{file.name}: no trip of two calls is left; leave the file out")
    counted["calls after midnight, kept as past 24 h"] += int((calls["time"] >= 86_400).sum())
    trips, boards, alights = calls["trip"].nunique(), calls["board"].sum(), calls["alight"].sum()
    fares = boards >= FARES_MISSING * trips
    counted["days without fares, not used for demand"] += int(not fares)
    expanded = fares and alights >= ALIGHTINGS_MISSING * boards
    counted["days whose alightings were not expanded, not used for them"] += int(fares and not expanded)
    counted["days of one operator only"] += int(len(set(calls["vehicle"].str[0])) == 1)
    return Day(date, calls, bool(fares), bool(expanded))


def read_node_boardings(raw: Path, counted: Counter[str]) -> dict[DayType, pd.DataFrame]:
    """Return, per day type, the mean boardings per day by stop_id and hour.

    Columns: stop_id, hour, board; `attrs['days']` is the number of files. These are raw counts, whereas
    boardings of trip records are expanded (2024-03-03: by 1.49). Bins begin at 05:00.
    """
    parts: dict[DayType, list[pd.DataFrame]] = {}
    for file in sorted(raw.rglob("node_temporal_features_*.parquet")):
        match = _NODES.fullmatch(file.name)
        if match is None:
            continue
        day, month, year = (int(part) for part in match.groups())
        date = dt.date(year, month, day)
        frame = _parquet(file, ("time", "node", "sobe", "carregamento"))
        counted["loads below 0 at stops, not used"] += int((frame["carregamento"] < 0).sum())
        hours = (pd.to_datetime(frame["time"]) - pd.Timestamp(date)).dt.total_seconds() // 3600
        counts = pd.DataFrame(
            {
                "stop_id": frame["node"].astype(str),
                "hour": hours.astype(np.int64),
                "board": frame["sobe"].fillna(0.0).clip(lower=0.0),
            }
        )
        parts.setdefault(day_type(date), []).append(counts)
    found: dict[DayType, pd.DataFrame] = {}
    for kind, frames in parts.items():
        total = pd.concat(frames).groupby(["stop_id", "hour"], as_index=False)["board"].sum()
        total["board"] /= len(frames)
        total.attrs["days"] = len(frames)
        found[kind] = total[total["board"] > 0]
    return found


def read_places(raw: Path) -> pd.DataFrame:
    """Return the coordinates of stops: lat, lon by stop_id.

    They are read from stop sequences, counts by stop and any stops.txt. Raises HeadwayError if there are no
    such files.
    """
    sequences = sorted(raw.rglob("gtfs_bus_topique*.parquet"))
    nodes = sorted(raw.rglob("node_temporal_features_*.parquet"))[:1]
    parts = [_parquet(file, ("stop_id", "lat", "lon")) for file in sequences]
    parts += [_parquet(file, ("node", "lat", "lon")).rename(columns={"node": "stop_id"}) for file in nodes]
    for file in sorted(raw.rglob("stops.txt")):
        text = pd.read_csv(file, dtype=str).rename(columns={"stop_lat": "lat", "stop_lon": "lon"})
        parts.append(text.reindex(columns=["stop_id", "lat", "lon"]))
    if not parts:
        raise HeadwayError(
            f"RAW: there is no gtfs_bus_topique*.parquet with coordinates of stops below {raw}; put it there"
        )
    places = pd.concat(parts, ignore_index=True).astype({"stop_id": "str", "lat": float, "lon": float})
    usable = places["lat"].between(-90, 90) & places["lon"].between(-180, 180)
    return places[usable].drop_duplicates("stop_id").set_index("stop_id")


def _parquet(file: Path, columns: tuple[str, ...]) -> pd.DataFrame:
    """Read columns of a Parquet file. Raises HeadwayError if it is unreadable or lacks a column."""
    from pyarrow import parquet

    if not file.is_file():
        raise HeadwayError(f"{file} is not a regular file; remove it")
    try:
        there = set(parquet.read_schema(file).names)
    except (OSError, ValueError) as error:
        raise HeadwayError(f"{file} is not a readable Parquet file; fetch it again ({error})") from error
    for column in columns:
        if column not in there:
            raise HeadwayError(f"{file.name} lacks column {column}: it is not a file of SUNT of this kind")
    return pd.read_parquet(file, columns=list(columns))
