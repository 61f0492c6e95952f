"""Days as one row per call, simulated or recorded, by SUNT or in an operator's calls.csv."""

import datetime as dt
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd

from headway.contracts import HeadwayError, Rule
from headway_envs.bus.env import BusBatchedEnv
from headway_envs.bus.kernel.layout import MOVE
from headway_envs.bus.prepared import Prepared
from headway_envs.bus.scenario.csv_files.calls import has_counts, read_calls
from headway_envs.bus.scenario.csv_files.files import SOURCE_PREFIX, is_there
from headway_envs.bus.scenario.csv_files.lines import read_lines
from headway_envs.bus.scenario.network import pattern_rows
from headway_envs.bus.scenario.sunt.records import find_days, read_day
from headway_envs.bus.scenario.tables import Tables
from headway_envs.constant_action import ConstantAction

COLUMNS = (
    *("line", "dir", "pattern", "trip", "seq0", "calls", "stop", "visit"),
    *("arrived", "left", "time", "boarded", "load"),
)
"""Columns of a day's calls, which are sorted by trip.

`trip`: number; `seq0`: position among the trip's `calls`; `visit`: number of earlier calls of the trip at
that stop; `arrived`, `left`: s after midnight, NaN where there is none; `time`: arrival (at the first call:
departure), s after midnight; `boarded`: passengers; `load`: passengers aboard at departure, NaN at the last
call.
"""


@dataclass(frozen=True)
class RecordedDay:
    """Recorded day of some lines."""

    date: str
    """Date, YYYY-MM-DD."""
    calls: pd.DataFrame
    """Rows with the columns of `COLUMNS`."""
    fares: bool
    """Whether passengers were counted; if not, `boarded` and `load` are meaningless."""


def simulated_days(
    tables: Tables, prepared: Prepared, days: int, rule: Rule | None = None, seed: int = 0
) -> Iterator[pd.DataFrame]:
    """Yield the calls (`COLUMNS`) of consecutive simulated days under a rule; None: always MOVE.

    `prepared` must be made from `tables`. Calls that no bus has reached by the end of the day are left out.
    Raises HeadwayError if `days` is below 1.
    """
    if days < 1:
        raise HeadwayError(f"days must be at least 1, not {days}")
    env = BusBatchedEnv(prepared, 1, traced=True)
    where = _trace_calls(tables, prepared)
    rule = rule or ConstantAction(prepared, MOVE)
    observed = env.reset(np.array([seed], np.uint64))
    for _ in range(days):
        ended = False
        while not ended:
            outcome, observed = env.step(rule.act(env, observed))
            ended = bool(outcome.episode_ended[0])
        trace = env.trace
        day = where.assign(
            arrived=trace.arrived[0], left=trace.left[0], boarded=trace.boarded[0], load=trace.load[0]
        )
        day["time"] = day["arrived"].where(day["seq0"] > 0, day["left"])
        yield day.loc[day["time"].notna(), list(COLUMNS)].reset_index(drop=True)


def recorded_day(raw: Path, tables: Tables, day_type: str) -> RecordedDay:
    """Return the recorded day on which the scenario's timetable is based, for its lines only.

    It is read from SUNT's files below `raw`, or from calls.csv in it; the metadata state its date. Raises
    HeadwayError if they state no valid date, or if there is no record of that date or no trip of these lines
    in it.
    """
    if not is_there(raw, "calls") and str(tables.meta.get("source")).startswith(SOURCE_PREFIX):
        raise HeadwayError(
            f"--records: there is no calls.csv in {raw}; give the folder that the scenario was made from"
        )
    files = {} if is_there(raw, "calls") else find_days(raw)
    stated = _timetable_date(tables, day_type)
    if not files:
        return _day_of_csv(raw, tables, stated)
    found = {str(date): (date, file) for date, file in files.items()}
    if stated not in found:
        raise HeadwayError(
            f"--records: {raw} lacks od-{stated}.parquet, the day of the scenario's timetable; put it there"
        )
    date, file = found[stated]
    day = read_day(file, date, Counter())
    calls = day.calls[day.calls["line"].isin(tables.patterns["line"])]
    if calls.empty:
        raise HeadwayError(f"--records: {file.name} has no trip of the scenario's lines")
    frame = pd.DataFrame(
        {
            "line": calls["line"],
            "dir": calls["dir"],
            "pattern": calls["line"] + " " + calls["dir"] + " " + calls["reg"],
            "trip": calls["trip"],
            "stop": calls["stop_id"],
            "arrived": calls["time"],
            "left": calls["time"],
            "time": calls["time"],
            "boarded": calls["board"],
            "load": calls["load_before"] + calls["board"] - calls["alight"],
        }
    )
    by_trip = frame.groupby("trip")["stop"]
    frame = frame.assign(seq0=by_trip.cumcount(), calls=by_trip.transform("size"))
    return RecordedDay(stated, _with_ends(frame), day.fares)


def _day_of_csv(folder: Path, tables: Tables, stated: str) -> RecordedDay:
    """Return the recorded day of a date in calls.csv, as `recorded_day` does."""
    lines = read_lines(folder)
    calls, _ = read_calls(folder, lines, Counter())
    calls = calls[(calls["date"] == stated) & calls["line"].isin(tables.patterns["line"])]
    if calls.empty:
        raise HeadwayError(
            f"--records: {folder / 'calls.csv'} has no trip of the scenario's lines on {stated}, its "
            "timetable's day; give the folder that the scenario was made from"
        )
    gained = calls["boardings"] - calls["alightings"]
    frame = pd.DataFrame(
        {
            "line": calls["line"],
            "dir": calls["direction"],
            "pattern": calls["pattern"],
            "trip": calls["run"],
            "seq0": calls["seq0"],
            "calls": lines.groupby("pattern").size().reindex(calls["pattern"]).to_numpy(),
            "stop": calls["stop"],
            "arrived": calls["arrival"],
            "left": calls["departure"],
            "time": calls["time"],
            "boarded": calls["boardings"],
            "load": gained.groupby(calls["run"]).cumsum(),
        }
    )
    return RecordedDay(stated, _with_ends(frame), has_counts(calls))


def _with_ends(calls: pd.DataFrame) -> pd.DataFrame:
    """Return recorded calls, in driving order, with `visit` and the trips' ends marked."""
    day = calls.assign(visit=calls.groupby(["trip", "stop"]).cumcount())
    day.loc[day["seq0"] == day["calls"] - 1, ["left", "load"]] = np.nan
    day.loc[day["seq0"] == 0, "arrived"] = np.nan
    return day.reset_index(drop=True)


def _timetable_date(tables: Tables, day_type: str) -> str:
    """Return the date of a day type's timetable as stated in the metadata, YYYY-MM-DD."""
    dates = tables.meta.get("dates") or {}
    if not isinstance(dates, Mapping):
        raise HeadwayError(f"meta.json: dates must be {{DAY_TYPE: YYYY-MM-DD}}, not {dates!r}")
    stated = dates.get(day_type) or tables.meta.get(f"ops_{day_type}")
    if stated is None:
        raise HeadwayError("meta.json names no date of the timetable: add dates: {DAY_TYPE: YYYY-MM-DD}")
    try:
        return str(dt.date.fromisoformat(stated))
    except (TypeError, ValueError):
        raise HeadwayError(
            f"meta.json: the date of a {day_type} must be text, YYYY-MM-DD, not {stated!r}"
        ) from None


def _trace_calls(tables: Tables, prepared: Prepared) -> pd.DataFrame:
    """Return line, dir, pattern, trip, seq0, calls, stop and visit of every entry of the trace."""
    network = prepared.network
    patterns = np.array(pattern_rows(tables.arrays(), prepared.config))
    stops = tables.pattern_stops.sort_values(["pattern", "seq0"]).groupby("pattern")["stop"].apply(list)
    names = tables.patterns.set_index("pattern")
    counts = np.diff(network.pattern_calls)[network.trip_pattern]
    pattern = patterns[network.trip_pattern]
    trips = pd.DataFrame(
        {
            "line": names["line"].astype(str).reindex(pattern).to_numpy(),
            "dir": names["dir"].astype(str).reindex(pattern).to_numpy(),
            "pattern": pattern,
            "trip": np.arange(len(pattern)),
            "calls": counts,
        }
    )
    calls = trips.loc[trips.index.repeat(counts)].reset_index(drop=True)
    calls["seq0"] = calls.groupby("trip").cumcount()
    calls["stop"] = np.concatenate([stops[p] for p in pattern])
    calls["visit"] = calls.groupby(["trip", "stop"]).cumcount()
    return calls
