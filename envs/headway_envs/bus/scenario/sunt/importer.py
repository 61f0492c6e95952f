"""Import of raw files of SUNT as a scenario's tables."""

import datetime as dt
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pandas as pd

from headway.contracts import HeadwayError
from headway_envs.bus.scenario.fitted import BOARDINGS_PER_TRIP
from headway_envs.bus.scenario.measures import distance_m
from headway_envs.bus.scenario.passengers import synthetic_passengers
from headway_envs.bus.scenario.sunt.counts import (
    alighting_table,
    demand_from_records,
    demand_from_stop_counts,
)
from headway_envs.bus.scenario.sunt.records import (
    Day,
    DayType,
    find_days,
    read_day,
    read_node_boardings,
    read_places,
)
from headway_envs.bus.scenario.sunt.times import link_times
from headway_envs.bus.scenario.tables import NO_LINK, Tables

ATTRIBUTION = (
    "SUNT, Salvador Urban Network Transportation (LabIA-UFBA), doi 10.17632/85fdtx3kr5.1, "
    "https://github.com/LabIA-UFBA/SUNT"
)
PATTERN_KEYS = ["line", "reg", "dir"]
"""Columns that identify a pattern."""


@dataclass(frozen=True)
class SuntOptions:
    """Selection from the raw files."""

    weekday: dt.date | None = None
    """Date of the weekday's timetable; None: the weekday with the most trips."""
    sunday: dt.date | None = None
    """Date of the Sunday's timetable; None: the Sunday with the most trips."""
    lines: Sequence[str] = ()
    """Names of the lines to import; empty: all."""
    seed: int = 0
    """Seed of synthetic demand, used where there are no counts."""


def import_sunt(raw: Path, options: SuntOptions) -> Tables:
    """Return the tables of the files below `raw`. Raises HeadwayError naming what is missing or wrong."""
    counted: Counter[str] = Counter()
    files = find_days(raw)
    places = read_places(raw)
    days = [read_day(file, date, counted) for date, file in files.items()]
    timetable = _timetable_days(days, {"weekday": options.weekday, "sunday": options.sunday})
    days = [_drop_unplaced_calls(day, places, counted) for day in days]
    timetable = {kind: next(d for d in days if d.date == day.date) for kind, day in timetable.items()}
    network, calls = _network(timetable, places, counted)
    nodes = read_node_boardings(raw, counted)
    trips = _trips(calls)
    length = network["patterns"].set_index("pattern")["n_stops"].reindex(trips["pattern"]).to_numpy()
    counted["trips that lack calls of their pattern, kept as whole"] += int((trips["n_stops"] < length).sum())
    made_from: dict[str, str] = {}
    demand = []
    rates = _boarding_rates(days)
    for kind, here in calls.items():
        own = [day for day in days if day.day_type == kind and day.fares]
        if own:
            rows, lost = demand_from_records(here, own)
            made_from[f"demand {kind}"] = f"trip records of {_dates(own)}, expanded counts"
        elif kind in nodes:
            rows, lost = demand_from_stop_counts(here, nodes[kind], rates)
            made_from[f"demand {kind}"] = f"counts by stop of {nodes[kind].attrs['days']} days, raw counts"
        else:
            means: dict[str, dict[int, float]] = {
                kind: dict.fromkeys(range(len(network["patterns"])), BOARDINGS_PER_TRIP[kind])
            }
            made = trips[trips["daytype"] == kind]
            rows, lost = synthetic_passengers(network["pattern_stops"], made, means, options.seed)[0], 0.0
            made_from[f"demand {kind}"] = f"made up: {BOARDINGS_PER_TRIP[kind]:g} boardings per trip"
        counted[f"boardings of a {kind} without a call there in that hour, left out"] += round(lost)
        demand.append(rows.assign(daytype=kind))
    alighting, alighting_days = alighting_table(network, [day for day in days if day.alightings])
    made_from["alighting"] = (
        f"trip records of {_dates(alighting_days)}" if alighting_days else "made up from fitted shares"
    )
    times = link_times(network, days, counted)
    tables = Tables(
        **network,
        link_times=times,
        demand=pd.concat(demand, ignore_index=True),
        alighting=alighting,
        trips=trips,
        meta={
            "source": ATTRIBUTION,
            "licence": "CC BY 4.0; changed: aggregated, cleaned, vehicles renumbered",
            "dates": {kind: str(day.date) for kind, day in timetable.items()},
            "made_from": {**made_from, "link_times": f"trip records of {_dates(days)}"},
            "counted": {name: count for name, count in counted.items() if count},
            "link_times_include_dwell": True,
        },
    )
    return _select_lines(tables, options.lines)


def _dates(days: Sequence[Day]) -> str:
    return ", ".join(str(day.date) for day in days)


def _select_lines(tables: Tables, lines: Sequence[str]) -> Tables:
    """Return the part of the tables that belongs to the named lines.

    Boardings have been divided among all lines before.
    """
    if not lines:
        return tables
    unknown = sorted(set(lines) - set(tables.patterns["line"]))
    if unknown:
        some = ", ".join(sorted(tables.patterns["line"].unique())[:8])
        raise HeadwayError(f"--lines: there is no line {unknown[0]}; the lines are {some}, ...")
    own = tables.patterns.loc[tables.patterns["line"].isin(list(lines)), "pattern"]
    calls = tables.pattern_stops[tables.pattern_stops["pattern"].isin(own)]
    kept = {
        "stops": tables.stops["stop"].isin(calls["stop"]),
        "links": tables.links["link"].isin(calls["link"]),
        "link_times": tables.link_times["link"].isin(calls["link"]),
    }
    for name in ("patterns", "pattern_stops", "demand", "alighting", "trips"):
        kept[name] = getattr(tables, name)["pattern"].isin(own)
    frames = {name: getattr(tables, name)[rows].reset_index(drop=True) for name, rows in kept.items()}
    return replace(tables, **frames, meta={**tables.meta, "lines": list(lines)})


def _timetable_days(days: Sequence[Day], wanted: Mapping[DayType, dt.date | None]) -> dict[DayType, Day]:
    """Return the day of each day type whose trips make up the timetable.

    Raises HeadwayError if there is none.
    """
    found: dict[DayType, Day] = {}
    for kind, date in wanted.items():
        own = [day for day in days if day.day_type == kind and day.trips]
        if date is not None:
            own = [day for day in own if day.date == date]
            if not own:
                there = _dates([day for day in days if day.day_type == kind]) or "none"
                raise HeadwayError(f"--{kind}: {date} is not a {kind} with trips here; available: {there}")
        if own:
            found[kind] = max(own, key=lambda day: day.trips)
    if not found:
        raise HeadwayError("od-*.parquet: there are trips on saturdays only, none on a weekday or sunday")
    return found


def _drop_unplaced_calls(day: Day, places: pd.DataFrame, counted: Counter[str]) -> Day:
    """Drop calls at stops without coordinates, and trips of which fewer than two calls remain."""
    known = day.calls["stop_id"].isin(places.index)
    counted["calls at stops without a place, left out"] += int((~known).sum())
    calls = day.calls[known]
    few = calls.groupby("trip")["seq"].transform("size") < 2
    counted["trips of one call at a known stop, left out"] += int(calls.loc[few, "trip"].nunique())
    return Day(day.date, calls[~few].reset_index(drop=True), day.fares, day.alightings)


def _network(
    timetable: Mapping[DayType, Day], places: pd.DataFrame, counted: Counter[str]
) -> tuple[dict[str, pd.DataFrame], dict[DayType, pd.DataFrame]]:
    """Return the tables stops, patterns, pattern_stops and links, and the calls of the timetable's days.

    Calls have the columns pattern, seq0 and hour. Patterns follow the recorded calls, because the dataset's
    files of stop sequences are older.
    """
    every = pd.concat([day.calls for day in timetable.values()], ignore_index=True)
    stops = every.groupby([*PATTERN_KEYS, "seq"])["stop_id"]
    counted["positions of patterns with another stop on the Sunday"] += int(stops.nunique().gt(1).sum())
    order = stops.first().reset_index()
    order["pattern"] = order.groupby(PATTERN_KEYS).ngroup()
    order["seq0"] = order.groupby("pattern").cumcount()
    counts = order.groupby("pattern").size()
    order = order[order["pattern"].map(counts) >= 2]
    used = sorted(order["stop_id"].unique())
    order["stop"] = pd.Index(used).get_indexer(pd.Index(order["stop_id"]))
    lat, lon = (places[column].reindex(used).to_numpy(np.float64) for column in ("lat", "lon"))
    stop = order["stop"].to_numpy()
    legs = distance_m(lat[stop], lon[stop], np.roll(lat[stop], 1), np.roll(lon[stop], 1))
    inner = order["seq0"].to_numpy() > 0
    order["leg_m"] = np.where(inner, np.round(legs), 0.0)
    pairs = np.column_stack((np.roll(stop, 1), stop))[inner]
    links, first, link = np.unique(pairs, axis=0, return_index=True, return_inverse=True)
    order["link"] = NO_LINK
    order.loc[inner, "link"] = link.ravel()
    patterns = order.groupby("pattern").agg(
        line=("line", "first"), dir=("dir", "first"), reg=("reg", "first"), n_stops=("seq0", "size")
    )
    patterns["length_m"] = order.groupby("pattern")["leg_m"].sum()
    network = {
        "stops": pd.DataFrame({"stop": np.arange(len(used)), "stop_id": used, "lat": lat, "lon": lon}),
        "patterns": patterns.reset_index(),
        "pattern_stops": order[["pattern", "seq0", "stop", "link", "leg_m"]].reset_index(drop=True),
        "links": pd.DataFrame(
            {
                "link": np.arange(len(links)),
                "from_stop": links[:, 0],
                "to_stop": links[:, 1],
                "leg_m": order["leg_m"].to_numpy()[inner][first],
            }
        ),
    }
    place = order[[*PATTERN_KEYS, "seq", "pattern", "seq0", "stop"]]
    calls = {
        kind: day.calls.merge(place, on=[*PATTERN_KEYS, "seq"]).assign(hour=lambda rows: rows["time"] // 3600)
        for kind, day in timetable.items()
    }
    return network, calls


def _trips(calls: Mapping[DayType, pd.DataFrame]) -> pd.DataFrame:
    """Return the table trips, with vehicles renumbered."""
    parts = []
    for kind, rows in calls.items():
        trips = rows.groupby("trip").agg(
            pattern=("pattern", "first"),
            vehicle=("vehicle", "first"),
            dep_s=("time", "min"),
            arr_s=("time", "max"),
            n_stops=("seq0", "size"),
        )
        parts.append(trips.assign(daytype=kind))
    table = pd.concat(parts, ignore_index=True)
    # Sorted by departure, so that vehicle numbers do not reveal the fleet's own.
    table = table.sort_values(["daytype", "dep_s", "pattern"], kind="stable", ignore_index=True)
    return table.assign(vehicle=pd.factorize(table["vehicle"])[0])


def _boarding_rates(days: Sequence[Day]) -> pd.Series:
    """Return the mean boardings per call by line, dir and stop_id, over all days with fares."""
    fares = [day.calls for day in days if day.fares]
    if not fares:
        return pd.Series(dtype=np.float64)
    return pd.concat(fares).groupby(["line", "dir", "stop_id"])["board"].mean()
