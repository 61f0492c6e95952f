"""Recorded calls (AVL) of an operator: trips, drives and, with counts (APC), passengers."""

from collections import Counter
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from headway.contracts import HeadwayError
from headway_envs.bus.scenario.csv_files.files import read_file, refuse, refuse_repeated
from headway_envs.bus.scenario.csv_files.lines import place_calls
from headway_envs.bus.scenario.link_times import plausible_drives
from headway_envs.bus.scenario.measures import TIMED_HOURS

_MIDNIGHT = "write times after midnight as 24:10, or drop the trip"
_COUNTS = ["boardings", "alightings"]
_DAY_TYPES = np.array(["weekday"] * 5 + ["saturday", "sunday"])


def read_calls(
    folder: Path, lines: pd.DataFrame, counted: Counter[str]
) -> tuple[pd.DataFrame, dict[str, str]]:
    """Return the rows of calls.csv by date, trip and position, and the date of each day type's timetable.

    Added columns: daytype, pattern, seq0, `run` (number of the trip among those of all dates) and `time`
    (arrival; at the first call, departure; s). The timetable is that of the date with the most trips.
    Boardings at the last stop of a direction, often those of the next trip, are counted and set to 0.
    """
    calls = place_calls(read_file(folder, "calls"), "calls", lines)
    timeless = calls["arrival"].isna() & calls["departure"].isna()
    refuse("calls", calls, "arrival", timeless, "is blank, as is departure; fill in one")
    refuse(
        "calls", calls, "departure", calls["departure"] < calls["arrival"], f"is before arrival; {_MIDNIGHT}"
    )
    run = calls.groupby(["date", "trip"]).ngroup()
    daytype = _DAY_TYPES[calls["date"].dt.day_of_week.to_numpy()]
    arrives = calls["arrival"].where((calls["seq0"] > 0) | calls["departure"].isna(), calls["departure"])
    calls = calls.assign(run=run, daytype=daytype, time=arrives.fillna(calls["departure"]))
    mixed = calls["pattern"] != calls.groupby("run")["pattern"].transform("first")
    refuse(
        "calls",
        calls,
        "trip",
        mixed,
        "is a trip of another direction, too; name each trip of a date differently",
    )
    refuse_repeated("calls", calls, ["run", "seq0"], "stop", "is given twice for this trip; keep one row")
    calls = calls.sort_values(["run", "seq0"])
    backwards = calls["time"] < calls.groupby("run")["time"].shift()
    refuse("calls", calls, "arrival", backwards, f"is before the call before; {_MIDNIGHT}")
    saturday = calls["daytype"] == "saturday"
    if saturday.all():
        raise HeadwayError("calls.csv has Saturdays only, which are left out: add weekdays or Sundays")
    counted["calls on Saturdays, left out"] += int(saturday.sum())
    single = calls.groupby("run")["run"].transform("size") < 2
    counted["trips of one call, left out"] += int(single.sum())
    calls = calls[~saturday & ~single]
    if calls.empty:
        raise HeadwayError("calls.csv has no trip of two calls on a weekday or Sunday: add some")
    last = lines.groupby("pattern")["seq0"].max().reindex(calls["pattern"]).to_numpy()
    late = (calls["seq0"] == last) & (calls["boardings"] > 0)
    counted["boardings at the last stop of a direction, left out"] += round(
        calls.loc[late, "boardings"].sum()
    )
    calls = calls.assign(boardings=calls["boardings"].mask(late, 0.0))
    trips = calls.drop_duplicates("run").groupby("daytype")["date"]
    dates = {str(day): str(own.mode().iloc[0].date()) for day, own in trips}
    return calls, dates


def trips_of_calls(
    calls: pd.DataFrame,
    dates: dict[str, str],
    link: "pd.Series[int]",
    times: pd.DataFrame,
    counted: Counter[str],
) -> pd.DataFrame:
    """Return the trips of the timetable's dates: pattern, vehicle (name), dep_s, arr_s, daytype.

    Missing first or last calls of a trip are completed by `times`, the table link_times; `link` by pattern
    and seq0.
    """
    own = calls[calls["date"] == pd.to_datetime(calls["daytype"].map(dates))]
    trips = own.groupby("run").agg(
        pattern=("pattern", "first"),
        vehicle=("vehicle", "first"),
        dep_s=("time", "min"),
        arr_s=("time", "max"),
        first=("seq0", "min"),
        last=("seq0", "max"),
        daytype=("daytype", "first"),
    )
    ends = link.reset_index().groupby("pattern")["seq0"].max().reindex(trips["pattern"]).to_numpy()
    partial = trips[(trips["first"] > 0) | (trips["last"] < ends)].reset_index()
    counted["trips without their first or last calls, completed by link times"] += len(partial)
    legs = link.rename("link").reset_index().merge(times, on="link")
    for column, sign in (("dep_s", -1.0), ("arr_s", 1.0)):
        hour = (partial[column] // 3600).clip(TIMED_HOURS[0], TIMED_HOURS[-1])
        driven = partial.assign(hour=hour).merge(legs, on=["pattern", "daytype", "hour"])
        before, after = driven["seq0"] <= driven["first"], driven["seq0"] > driven["last"]
        missing_s = driven[before if sign < 0 else after].groupby("run")["mean_s"].sum().round()
        trips[column] += sign * missing_s.reindex(trips.index, fill_value=0.0)
    trips["dep_s"] = trips["dep_s"].clip(lower=0.0)
    trips = trips.sort_values(["daytype", "dep_s", "pattern"], kind="stable", ignore_index=True)
    return trips.drop(columns=["first", "last"])


def drives_of_calls(
    calls: pd.DataFrame, link: "pd.Series[int]", metres: NDArray[np.float64], counted: Counter[str]
) -> pd.DataFrame:
    """Return link, hour and duration (s) of each plausible drive; `link` by pattern and seq0."""
    later = calls.shift(-1)
    following = ((calls["run"] == later["run"]) & (calls["seq0"] + 1 == later["seq0"])).to_numpy()
    ends = pd.MultiIndex.from_arrays([calls["pattern"][following], calls["seq0"][following] + 1])
    legs = pd.DataFrame(
        {
            "link": link.reindex(ends).to_numpy(np.int64),
            "hour": (calls["time"][following] // 3600).to_numpy(),
            "s": (later["time"] - calls["time"])[following].to_numpy(),
        }
    )
    return plausible_drives(legs, metres, counted)


def has_counts(calls: pd.DataFrame) -> bool:
    """Return whether every call has its boardings and alightings."""
    return bool(calls[_COUNTS].notna().all(axis=None))


def counts_of_calls(calls: pd.DataFrame) -> pd.DataFrame:
    """Return mean counts per day: pattern, seq0, hour, boardings, alightings, daytype."""
    keys = ["daytype", "pattern", "seq0", "hour"]
    hours = (calls["time"] // 3600).astype(np.int64)
    sums = calls.assign(hour=hours).groupby(keys)[_COUNTS].sum()
    days = calls.groupby("daytype")["date"].nunique()
    return sums.div(days, axis=0, level="daytype").reset_index()
