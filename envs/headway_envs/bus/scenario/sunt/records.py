"""Raw files of SUNT: trip records by day, counts by stop, and coordinates of stops.

Irregularities are corrected and counted.
"""

import datetime as dt
import re
import shlex
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

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
MOST_CALLS = 10_000
"""Largest plausible number of a call within a trip."""
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
        raise HeadwayError(f"{raw} is not a folder; give the one that holds SUNT's files od-*.parquet")
    found = {
        dt.date(*(int(part) for part in match.groups())): file
        for file in sorted(raw.rglob("od-*.parquet"))
        if (match := _OD.fullmatch(file.name))
    }
    if not found and (raw / "pattern_stops.parquet").is_file():
        scenario = shlex.quote(f"env.args.scenario={raw}")
        raise HeadwayError(f"{raw} is a scenario already; use it as it is: {scenario}")
    if not found:
        raise HeadwayError(f"there is no file od-YYYY-MM-DD.parquet below {raw}")
    return found


def read_day(file: Path, date: dt.date, counted: Counter[str]) -> Day:
    """Read, correct and check the trip records of one day.

    Raises HeadwayError for missing columns, values of a wrong type, and files without a usable trip.
    """
    frame = _parquet(file, _COLUMNS)
    frame = frame.astype(dict.fromkeys(("route_short_name", "direction_id", "vehicle", "trip_id"), "str"))
    sequence = _numbers(file, frame["pt_sequence"])
    _refuse_first(file, frame["pt_sequence"], ~sequence.between(0, MOST_CALLS), "the number of a call")
    calls = pd.DataFrame(
        {
            "line": frame["route_short_name"],
            "reg": frame["register_code"].astype(str),
            "dir": frame["direction_id"],
            "seq": sequence.astype(np.int64),
            "stop_id": frame["stop_id"].astype(str),
            "trip": frame.groupby(list(TRIP_KEYS), sort=False).ngroup(),
            "vehicle": frame["vehicle"],
            "time": _seconds_of_day(file, frame["stop_time"], date),
            "board": _numbers(file, frame["n-boardings"]),
            "alight": _numbers(file, frame["n-alighting"]),
            "load_before": _numbers(file, frame["lag_loading"]),
        }
    )
    blank = calls["time"].isna()
    counted["calls without a time, left out"] += int(blank.sum())
    loads = _numbers(file, frame["loading"])
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
        counted[f"fractional {name} (expanded), kept"] += int((values % 1 != 0).sum())
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
        counted["loads below 0 at stops, not used"] += int((_numbers(file, frame["carregamento"]) < 0).sum())
        seconds = _seconds_of_day(file, frame["time"], date)
        _refuse_first(file, frame["time"], seconds.isna(), "a time")
        counts = pd.DataFrame(
            {
                "stop_id": frame["node"].astype(str),
                "hour": (seconds // 3600).astype(np.int64),
                "board": _numbers(file, frame["sobe"]).fillna(0.0).clip(lower=0.0),
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
    parts = [(file, _parquet(file, ("stop_id", "lat", "lon"))) for file in sequences]
    parts += [
        (file, _parquet(file, ("node", "lat", "lon")).rename(columns={"node": "stop_id"})) for file in nodes
    ]
    for file in sorted(raw.rglob("stops.txt")):
        text = pd.read_csv(file, dtype=str).rename(columns={"stop_lat": "lat", "stop_lon": "lon"})
        parts.append((file, text.reindex(columns=["stop_id", "lat", "lon"])))
    if not parts:
        raise HeadwayError(
            f"there is no gtfs_bus_topique*.parquet with coordinates of stops below {raw}; put it there"
        )
    read = [
        part.assign(**{name: _numbers(file, part[name]) for name in ("lat", "lon")}) for file, part in parts
    ]
    places = pd.concat(read, ignore_index=True).astype({"stop_id": "str"})
    usable = places["lat"].between(-90, 90) & places["lon"].between(-180, 180)
    return places[usable].drop_duplicates("stop_id").set_index("stop_id")


def _numbers(file: Path, values: "pd.Series[Any]") -> "pd.Series[float]":
    """Return a column as float64, NaN where blank. Raises HeadwayError naming the first other value."""
    found = pd.to_numeric(values, errors="coerce").astype(np.float64)
    _refuse_first(file, values, found.isna() & values.notna(), "a number")
    return found


def _seconds_of_day(file: Path, values: "pd.Series[Any]", date: dt.date) -> "pd.Series[float]":
    """Return times, possibly texts, as seconds after midnight of `date`, NaN where blank.

    Raises HeadwayError naming the first other value.
    """
    texts = values if pd.api.types.is_datetime64_any_dtype(values) else values.astype("str")
    found = pd.to_datetime(texts, errors="coerce", format="ISO8601", utc=True).dt.tz_localize(None)
    _refuse_first(file, values, found.isna() & values.notna(), "a time")
    return (found - pd.Timestamp(date)).dt.total_seconds()


def _refuse_first(file: Path, values: "pd.Series[Any]", wrong: "pd.Series[bool]", what: str) -> None:
    """Raise HeadwayError naming the first row where `wrong`, if any."""
    if wrong.any():
        row = int(np.flatnonzero(wrong)[0])
        raise HeadwayError(
            f"{file.name}, row {row}, {values.name}: '{values.iloc[row]}' is not {what}; correct it, fetch "
            "the file again, or leave it out"
        )


def _parquet(file: Path, columns: tuple[str, ...]) -> pd.DataFrame:
    """Read columns of a Parquet file. Raises HeadwayError if it is unreadable or lacks a column."""
    from pyarrow import parquet

    if not file.is_file():
        raise HeadwayError(f"{file} is not a regular file; remove it")
    try:
        there = set(parquet.read_schema(file).names)
        if missing := [column for column in columns if column not in there]:
            raise HeadwayError(
                f"{file.name} lacks column {missing[0]}: it is not a file of SUNT of this kind"
            )
        return pd.read_parquet(file, columns=list(columns))
    except (OSError, ValueError) as error:
        raise HeadwayError(f"{file} is not a readable Parquet file; fetch it again ({error})") from error
