"""Import of a line in the tables of TransitGym (github.com/TransitGym), the simulator of CAAC.

A folder holds stops.txt, trips.txt and stop_times.txt, which resemble a GTFS feed without calendar and
routes, and demand.csv, rides by smart card. They are rewritten as the CSV files of an operator, and these are
imported.
"""

import tempfile
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from headway.contracts import HeadwayError
from headway_envs.bus.scenario.csv_files.files import read_texts
from headway_envs.bus.scenario.csv_files.importer import import_csv
from headway_envs.bus.scenario.measures import METRES_PER_DEGREE
from headway_envs.bus.scenario.tables import Tables

COLUMNS = {
    "stops.txt": ("stop_id", "stop_lat", "stop_lon"),
    "trips.txt": ("trip_id", "route_id"),
    "stop_times.txt": ("trip_id", "stop_id", "arrival_time", "shape_dist_traveled"),
    "demand.csv": ("BOARDING_STOP_STN", "ALIGHTING_STOP_STN", "Ride_Start_Time"),
}
"""Columns that are read. Times are HH:MM:SS or YYYY-MM-DD HH:MM:SS, distances in km from the first stop."""
_DAY_ENDS_S = 31 * 3600
"""Latest time of a service day that has begun at midnight, s."""


def import_transitgym(folder: Path) -> Tables:
    """Return the tables of the lines in `folder`, all of one weekday.

    A line without coordinates (all 0) lies on a straight road. Raises HeadwayError naming file, row and
    column of a fault, of the rewritten files if it is found there.
    """
    if not folder.is_dir():
        raise HeadwayError(f"{folder} is not a folder; give the one that holds {', '.join(COLUMNS)}")
    read = {name: _read(folder, name) for name in COLUMNS}
    counted: Counter[str] = Counter()
    calls = _calls(read["stop_times.txt"], read["trips.txt"], counted)
    lines = _lines(calls)
    stops, placed = _stops(read["stops.txt"], calls)
    files = {
        "stops": stops,
        "lines": lines[["line", "direction", "stop", "distance_m"]],
        "trips": _trips(calls),
        "link_times": _link_times(calls),
        "demand": _demand(read["demand.csv"], lines, counted),
    }
    with tempfile.TemporaryDirectory() as place:
        for name, frame in files.items():
            frame.to_csv(Path(place) / f"{name}.csv", index=False)
        try:
            tables = import_csv(Path(place))
        except HeadwayError as error:
            raise HeadwayError(f"{folder}, rewritten as CSV files of an operator: {error}") from error
    meta = dict(tables.meta)
    meta["source"] = f"TransitGym tables of {folder.resolve().name}"
    meta["licence"] = "that of the files"
    meta["made_up"] = {
        "spread of link times": "fitted to SUNT",
        **({"coordinates": "a straight road"} if placed else {}),
    }
    meta["counted"] = {**meta["counted"], **{name: count for name, count in counted.items() if count}}
    return replace(tables, meta=meta)


def _read(folder: Path, name: str) -> pd.DataFrame:
    """Return the columns of a file as text, stripped. Raises HeadwayError if it or a column is missing."""
    path = folder / name
    if not path.is_file():
        raise HeadwayError(f"{path} is missing; TransitGym's tables are {', '.join(COLUMNS)}")
    frame, _ = read_texts(path)
    for column in COLUMNS[name]:
        if column not in frame:
            there = ", ".join(frame.columns)
            raise HeadwayError(f"{name}, row 1: there is no column {column}; the columns are {there}")
    return frame[list(COLUMNS[name])]


def _refuse(
    name: str, frame: pd.DataFrame, column: str, bad: "pd.Series[bool] | NDArray[Any]", problem: str
) -> None:
    """Raise HeadwayError naming file, row, column and value of the first row where `bad`, if any."""
    if bad.any():
        row = frame.index[int(np.flatnonzero(bad)[0])]
        raise HeadwayError(f"{name}, row {row}, column {column}: '{frame[column][row]}' {problem}")


def _numbers(name: str, frame: pd.DataFrame, column: str) -> "pd.Series[float]":
    values = pd.to_numeric(frame[column], errors="coerce").astype(np.float64)
    _refuse(name, frame, column, ~np.isfinite(values), "is not a number; correct it")
    return values


def _seconds(name: str, frame: pd.DataFrame, column: str) -> "pd.Series[float]":
    """Return times as s after midnight of the first date in the column."""
    parts = frame[column].str.rpartition(" ")
    day, clock = parts[0], parts[2]
    date = pd.to_datetime(day.where(day != "", "1900-01-01"), format="%Y-%m-%d", errors="coerce")
    within = pd.to_timedelta(clock.where(clock.str.fullmatch(r"\d{1,2}:\d\d:\d\d")), errors="coerce")
    seconds = (date - date.min() + within).dt.total_seconds()
    wrong = seconds.isna()
    _refuse(name, frame, column, wrong, "is not a time HH:MM:SS or YYYY-MM-DD HH:MM:SS; correct it")
    return seconds


def _calls(times: pd.DataFrame, trips: pd.DataFrame, counted: Counter[str]) -> pd.DataFrame:
    """Return one row per call, by trip and time: trip, line, direction, stop, seq0, time (s), along (m).

    Each sequence of stops of a line is a direction, numbered from 1 by its number of trips.
    """
    name = "stop_times.txt"
    line = trips.drop_duplicates("trip_id").set_index("trip_id")["route_id"].reindex(times["trip_id"])
    calls = pd.DataFrame(
        {
            "trip": times["trip_id"],
            "line": line.to_numpy(),
            "stop": times["stop_id"],
            "time": _seconds(name, times, "arrival_time"),
            "along": 1000.0 * _numbers(name, times, "shape_dist_traveled"),
        }
    )
    counted["calls of trips that trips.txt lacks, left out"] += int(calls["line"].isna().sum())
    calls = calls[calls["line"].notna()].sort_values(["trip", "time", "along"], kind="stable")
    single = calls.groupby("trip")["trip"].transform("size") < 2
    counted["trips of one call, left out"] += int(single.sum())
    calls = calls[~single]
    if calls.empty:
        raise HeadwayError(f"{name} has no trip of two calls that trips.txt names: check trip_id")
    back = (calls["trip"] == calls["trip"].shift()) & (calls["along"] <= calls["along"].shift())
    _refuse(
        name,
        times.loc[calls.index],
        "shape_dist_traveled",
        back,
        "is not beyond the stop before; give the distance from the first stop, km",
    )
    calls["seq0"] = calls.groupby("trip").cumcount()
    sequence = calls.groupby("trip")["stop"].agg("|".join)
    lines = calls.groupby("trip")["line"].first()
    counts = pd.DataFrame({"line": lines, "sequence": sequence}).value_counts().reset_index()
    counts["direction"] = counts.groupby("line").cumcount() + 1
    direction = counts.set_index(["line", "sequence"])["direction"]
    of_trip = pd.Series(
        direction.reindex(pd.MultiIndex.from_arrays([lines, sequence])).to_numpy(), sequence.index
    )
    return calls.assign(direction=of_trip.reindex(calls["trip"]).to_numpy())


def _lines(calls: pd.DataFrame) -> pd.DataFrame:
    """Return the calls of each direction's first trip, with the distance from the call before, m."""
    first = calls.groupby(["line", "direction"])["trip"].transform("first")
    lines = calls[calls["trip"] == first].sort_values(["line", "direction", "seq0"])
    return lines.assign(distance_m=lines.groupby(["line", "direction"])["along"].diff().round(1))


def _stops(stops: pd.DataFrame, calls: pd.DataFrame) -> tuple[pd.DataFrame, bool]:
    """Return stop, lat and lon of the stops with calls, and whether they were placed on a straight road."""
    name = "stops.txt"
    stops = stops.drop_duplicates("stop_id")
    lat, lon = _numbers(name, stops, "stop_lat"), _numbers(name, stops, "stop_lon")
    placed = bool((lat == 0).all() and (lon == 0).all())
    frame = pd.DataFrame({"stop": stops["stop_id"], "lat": lat, "lon": lon}).set_index("stop")
    along = calls.groupby("stop")["along"].min()
    unknown = ~calls["stop"].isin(frame.index)
    if unknown.any():
        raise HeadwayError(
            f"stop_times.txt, row {calls.index[np.flatnonzero(unknown)[0]]}, column stop_id: stop "
            f"'{calls['stop'][unknown].iloc[0]}' is not in {name}; add it there or correct it"
        )
    if placed:
        if len(calls["line"].unique()) > 1:
            raise HeadwayError(
                f"{name}: several lines need coordinates of their stops; fill them in, or give one line"
            )
        frame["lon"] = (along / METRES_PER_DEGREE).reindex(frame.index)
    return frame.loc[frame.index.isin(along.index)].reset_index(), placed


def _trips(calls: pd.DataFrame) -> pd.DataFrame:
    """Return trips.csv."""
    ends = calls.groupby("trip").agg(
        line=("line", "first"),
        direction=("direction", "first"),
        departure=("time", "min"),
        arrival=("time", "max"),
    )
    ends = ends.sort_values(["departure", "line", "direction"])
    return ends.assign(departure=ends["departure"].map(_clock), arrival=ends["arrival"].map(_clock))


def _link_times(calls: pd.DataFrame) -> pd.DataFrame:
    """Return link_times.csv: the means of the planned times by hour."""
    later = calls.shift(-1)
    inner = calls["trip"] == later["trip"]
    legs = pd.DataFrame(
        {
            "from_stop": calls["stop"],
            "to_stop": later["stop"],
            "hour": (calls["time"] // 3600).astype(np.int64),
            "mean_s": later["time"] - calls["time"],
        }
    )[inner]
    means = legs.groupby(["from_stop", "to_stop", "hour"])["mean_s"].mean()
    return means.clip(lower=1.0).round(1).reset_index()


def _demand(rides: pd.DataFrame, lines: pd.DataFrame, counted: Counter[str]) -> pd.DataFrame:
    """Return demand.csv: rides by line, origin, destination and hour.

    A ride belongs to the first direction that reaches its destination after its origin.
    """
    seconds = _seconds("demand.csv", rides, "Ride_Start_Time")
    late = seconds >= _DAY_ENDS_S
    _refuse("demand.csv", rides, "Ride_Start_Time", late, "is of another day; give the rides of one day")
    blank = rides["ALIGHTING_STOP_STN"] == ""
    counted["rides without an alighting stop, left out"] += int(blank.sum())
    # Columns of numbers with gaps are written as 64461.0.
    stop = {name: rides[name].str.removesuffix(".0") for name in COLUMNS["demand.csv"][:2]}
    rides = pd.DataFrame(
        {
            "stop": stop["BOARDING_STOP_STN"],
            "to_stop": stop["ALIGHTING_STOP_STN"],
            "hour": (seconds // 3600).astype(np.int64),
        }
    )[~blank]
    rides = rides.reset_index(names="ride")
    calls = lines[["line", "direction", "stop", "seq0"]]
    ends = calls.set_axis(["line", "direction", "to_stop", "to_seq0"], axis=1)
    pairs = rides.merge(calls, on="stop").merge(ends, on=["line", "direction", "to_stop"])
    pairs = pairs[pairs["to_seq0"] > pairs["seq0"]].sort_values(["ride", "line", "direction", "seq0"])
    found = pairs.drop_duplicates("ride")
    counted["rides between stops that no direction serves in this order, left out"] += len(rides) - len(found)
    if found.empty:
        raise HeadwayError("demand.csv has no ride between two stops of a line in stop_times.txt")
    keys = ["line", "direction", "stop", "position", "to_stop", "hour"]
    return found.assign(position=found["seq0"] + 1).groupby(keys).size().rename("boardings").reset_index()


def _clock(seconds: float) -> str:
    """Format s after midnight as 24:10:00."""
    whole = round(seconds)
    return f"{whole // 3600:02d}:{whole % 3600 // 60:02d}:{whole % 60:02d}"
