"""Import of a GTFS feed as a scenario's tables."""

import datetime as dt
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from headway.contracts import HeadwayError
from headway_envs.bus.scenario.blocks import chain_at_terminals, terminals
from headway_envs.bus.scenario.fitted import BOARDINGS_PER_TRIP, SOURCE, WITHIN_HOUR_SD
from headway_envs.bus.scenario.gtfs.calls import Calls, clean_calls, places
from headway_envs.bus.scenario.gtfs.feed import Feed, numbers, read_feed, seconds
from headway_envs.bus.scenario.gtfs.service import chosen_days
from headway_envs.bus.scenario.measures import MAX_SPEED_MPS, TIMED_HOURS
from headway_envs.bus.scenario.passengers import synthetic_passengers
from headway_envs.bus.scenario.tables import NO_LINK, Tables

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

BUS_TYPES = (
    "3",
    "11",
    *(str(kind) for kind in range(200, 210)),
    *(str(kind) for kind in range(700, 717)),
    "800",
)
"""Route types of buses, trolleybuses and coaches, including the extended ones."""
_FIRST_HOUR, _LAST_HOUR = int(TIMED_HOURS[0]), int(TIMED_HOURS[-1])
_MIN_LINK_S = 5.0


@dataclass(frozen=True)
class GtfsOptions:
    """Selection from a feed, and assumptions about passengers."""

    weekday: dt.date | None = None
    """Date of the weekday's timetable; None: the weekday with the most trips."""
    sunday: dt.date | None = None
    """Date of the Sunday's timetable; None: the Sunday with the most trips."""
    lines: Sequence[str] = ()
    """Names of the lines to import; empty: all."""
    route_types: Sequence[str] = BUS_TYPES
    """Route types to import."""
    boardings_per_trip: float = BOARDINGS_PER_TRIP["weekday"]
    """Mean boardings per trip on a weekday; Sundays have the fitted share of them."""
    seed: int = 0
    """Seed of the random weights of stops in the demand."""


def import_gtfs(path: Path, options: GtfsOptions) -> Tables:
    """Return the tables of a feed.

    Raises HeadwayError naming file, line and column of what cannot be read.
    """
    feed = read_feed(path)
    counted: Counter[str] = Counter()
    trips = _chosen_trips(feed, options)
    days = chosen_days(feed, trips, {"weekday": options.weekday, "sunday": options.sunday})
    trips = trips[trips["service_id"].isin(set.union(*(services for _, services in days.values())))]
    trips = trips.reset_index(drop=True)
    stops, rows = places(feed)
    calls, irregularities = clean_calls(feed, trips, stops, rows)
    counted.update(irregularities)
    trips = trips.assign(pattern=_patterns(trips, calls))
    day_trips = _day_trips(feed, trips, calls, days, counted)
    tables = _network(trips, calls, stops)
    table = _trip_table(day_trips, trips, calls, stops, counted)
    times = _link_times(tables, day_trips, trips, calls, counted)
    scale = options.boardings_per_trip / BOARDINGS_PER_TRIP["weekday"]
    per_trip = {
        day: dict.fromkeys(tables["patterns"]["pattern"].tolist(), BOARDINGS_PER_TRIP[day] * scale)
        for day in days
    }
    demand, alighting = synthetic_passengers(tables["pattern_stops"], table, per_trip, options.seed)
    return Tables(
        **tables,
        link_times=times,
        demand=demand,
        alighting=alighting,
        trips=table,
        meta=_meta(feed, days, options, counted),
    )


def _chosen_trips(feed: Feed, options: GtfsOptions) -> pd.DataFrame:
    """Return the trips of the chosen lines, with columns `line` and `way` (direction)."""
    routes = feed["routes"].drop_duplicates("route_id").copy()
    names = routes["route_short_name"].fillna(routes["route_long_name"]).fillna(routes["route_id"])
    agency = routes["agency_id"].fillna("")
    agencies = agency.groupby(names).transform("nunique")
    routes["line"] = names.where(agencies < 2, agency + ":" + names)
    # Feeds without direction_id often have a separate route per direction.
    routes["order"] = routes.groupby("line").cumcount()
    chosen = routes[routes["route_type"].isin(list(options.route_types))]
    if chosen.empty:
        there = ", ".join(sorted(set(routes["route_type"].dropna())))
        raise HeadwayError(
            f"{feed.path}: no route is a bus; its route types are {there}: choose some with --types"
        )
    if options.lines:
        unknown = sorted(set(options.lines) - set(chosen["line"]))
        if unknown:
            some = ", ".join(sorted(chosen["line"].unique())[:8])
            raise HeadwayError(f"--lines: the feed has no line {unknown[0]}; it has {some}, ...")
        chosen = chosen[chosen["line"].isin(list(options.lines))]
    trips = (
        feed["trips"].drop_duplicates("trip_id").merge(chosen[["route_id", "line", "order"]], on="route_id")
    )
    if trips.empty:
        raise HeadwayError(f"{feed.path}: none of the chosen routes has a trip in trips.txt")
    given = trips["direction_id"].map({"0": "I", "1": "V"})
    by_order = trips["order"].mod(2).map({0: "I", 1: "V"})
    return trips.assign(way=given.fillna(by_order)).drop(columns="order")


def _patterns(trips: pd.DataFrame, calls: Calls) -> Integers:
    """Return a pattern number per trip (trips,), one per stop sequence of a line and direction.

    Patterns are numbered by line; -1 for trips without calls.
    """
    bounds = [*calls.first.tolist(), len(calls.trip)]
    line, way = trips["line"].to_numpy(), trips["way"].to_numpy()
    sequences: dict[tuple[str, str, bytes], list[int]] = {}
    for begin, end in pairwise(bounds):
        trip = int(calls.trip[begin])
        key = (str(line[trip]), str(way[trip]), calls.stop[begin:end].tobytes())
        sequences.setdefault(key, []).append(trip)
    pattern = np.full(len(trips), -1)
    ordered = sorted(sequences, key=lambda key: (key[0], key[1], -len(sequences[key]), key[2]))
    for number, key in enumerate(ordered):
        pattern[sequences[key]] = number
    return pattern.astype(np.int64)


def _network(trips: pd.DataFrame, calls: Calls, stops: pd.DataFrame) -> dict[str, pd.DataFrame]:
    """Return the tables stops, patterns, pattern_stops and links."""
    begins = calls.first
    numbers_here = trips["pattern"].to_numpy()[calls.trip[begins]]
    _, example = np.unique(numbers_here, return_index=True)
    ends = np.append(begins[1:], len(calls.trip))
    rows = np.concatenate([np.arange(begins[i], ends[i]) for i in example])
    counts = (ends - begins)[example]
    used, stop = np.unique(calls.stop[rows], return_inverse=True)
    seq0 = np.concatenate([np.arange(count) for count in counts])
    inner = seq0 > 0
    legs = np.maximum(np.round(np.diff(calls.along[rows], prepend=0.0)), 1.0)
    pairs = np.column_stack((np.roll(stop, 1), stop))[inner]
    links, first, link = np.unique(pairs, axis=0, return_index=True, return_inverse=True)
    links_in = np.full(len(seq0), NO_LINK, np.int64)
    links_in[inner] = link.ravel()
    owners = trips.iloc[calls.trip[begins[example]]]
    return {
        "stops": stops.iloc[used].reset_index(drop=True).assign(stop=np.arange(len(used))),
        "patterns": pd.DataFrame(
            {
                "pattern": np.arange(len(example)),
                "line": owners["line"].to_numpy(),
                "dir": owners["way"].to_numpy(),
                "n_stops": counts,
                "length_m": np.round(calls.along[ends[example] - 1]),
            }
        ),
        "pattern_stops": pd.DataFrame(
            {
                "pattern": np.repeat(np.arange(len(example)), counts),
                "seq0": seq0,
                "stop": stop,
                "link": links_in,
                "leg_m": np.where(inner, legs, 0.0),
            }
        ),
        "links": pd.DataFrame(
            {
                "link": np.arange(len(links)),
                "from_stop": links[:, 0],
                "to_stop": links[:, 1],
                "leg_m": legs[inner][first],
            }
        ),
    }


def _day_trips(
    feed: Feed,
    trips: pd.DataFrame,
    calls: Calls,
    days: dict[str, tuple[dt.date, set[str]]],
    counted: Counter[str],
) -> pd.DataFrame:
    """Return one row per departure of a trip on a day type: daytype, trip (row), shift.

    `shift` is the difference of its times to stop_times, s.
    """
    has_calls = trips["pattern"].to_numpy() >= 0
    first = np.full(len(trips), np.nan)
    first[calls.trip[calls.first]] = calls.time[calls.first]
    repeated = _frequencies(feed, trips, first)
    parts = []
    for day, (_, services) in days.items():
        mine = has_calls & trips["service_id"].isin(services).to_numpy()
        here = repeated[mine[repeated["trip"].to_numpy()]]
        single = np.flatnonzero(mine & ~np.isin(np.arange(len(trips)), repeated["trip"]))
        counted["departures of frequencies.txt"] += len(here)
        part = pd.concat([pd.DataFrame({"trip": single, "shift": 0.0}), here], ignore_index=True)
        parts.append(part.assign(daytype=day))
    day_trips: pd.DataFrame = pd.concat(parts, ignore_index=True)
    if day_trips.empty:
        raise HeadwayError(f"{feed.path}: no trip of the chosen days can be used; check stop_times.txt")
    return day_trips


def _frequencies(feed: Feed, trips: pd.DataFrame, first: Floats) -> pd.DataFrame:
    """Return every departure stated by frequencies.txt: trip (row), shift."""
    frame = feed["frequencies"]
    row = pd.Index(trips["trip_id"]).get_indexer(pd.Index(frame["trip_id"]))
    begin = seconds("frequencies", "start_time", frame["start_time"])
    end = seconds("frequencies", "end_time", frame["end_time"])
    every = numbers("frequencies", "headway_secs", frame["headway_secs"])
    wrong = np.flatnonzero((row >= 0) & ~((every >= 1) & (end >= begin)))
    if len(wrong):
        raise HeadwayError(
            f"frequencies.txt, line {wrong[0] + 2}: headway_secs must be at least 1 and end_time not "
            "before start_time"
        )
    found = [
        pd.DataFrame({"trip": row[i], "shift": np.arange(begin[i], end[i], every[i]) - first[row[i]]})
        for i in np.flatnonzero(row >= 0)
        if not np.isnan(first[row[i]])
    ]
    if not found:
        return pd.DataFrame({"trip": np.zeros(0, np.int64), "shift": np.zeros(0)})
    return pd.concat(found, ignore_index=True)


def _trip_table(
    day_trips: pd.DataFrame, trips: pd.DataFrame, calls: Calls, stops: pd.DataFrame, counted: Counter[str]
) -> pd.DataFrame:
    """Return the table trips.

    Vehicles follow block_id if every trip of the day has one; else, and for blocks with overlapping trips,
    they are chained at terminals.
    """
    begin = calls.first
    last = np.append(begin[1:], len(calls.trip)) - 1
    terminal = terminals(stops, np.concatenate((calls.stop[begin], calls.stop[last])))
    ends = pd.DataFrame(
        {
            "dep_s": calls.time[begin],
            "arr_s": calls.time[last],
            "begin": [terminal[stop] for stop in calls.stop[begin].tolist()],
            "end": [terminal[stop] for stop in calls.stop[last].tolist()],
            "n_stops": last - begin + 1,
        },
        index=calls.trip[begin],
    )
    row = day_trips["trip"].to_numpy()
    table = ends.reindex(row).reset_index(drop=True)
    table = table.assign(
        pattern=trips["pattern"].to_numpy()[row],
        dep_s=table["dep_s"] + day_trips["shift"].to_numpy(),
        arr_s=table["arr_s"] + day_trips["shift"].to_numpy(),
        block=trips["block_id"].to_numpy()[row],
        daytype=day_trips["daytype"].to_numpy(),
    )
    parts = []
    for _, part in table.groupby("daytype", sort=False):
        # Repetitions of a trip by frequencies.txt have the same block_id, but need not share a vehicle.
        blocked = part["block"].notna().all() and not day_trips["trip"].iloc[part.index].duplicated().any()
        counted["days with vehicles by block_id"] += int(blocked)
        vehicle = _vehicles_by_block(part, counted) if blocked else chain_at_terminals(part)
        parts.append(part.assign(vehicle=vehicle))
    columns = ["pattern", "vehicle", "dep_s", "arr_s", "n_stops", "daytype"]
    return pd.concat(parts, ignore_index=True)[columns]


def _vehicles_by_block(trips: pd.DataFrame, counted: Counter[str]) -> Integers:
    """Return a vehicle for each trip (J,): one per block, or as many as necessary if its trips overlap."""
    vehicle = pd.factorize(trips["block"])[0].astype(np.int64)
    ordered = trips.assign(vehicle=vehicle).sort_values(["vehicle", "dep_s", "arr_s"])
    before = ordered.groupby("vehicle")["arr_s"].cummax().groupby(ordered["vehicle"]).shift()
    overlapping = ordered.loc[ordered["dep_s"] < before, "vehicle"].unique()
    counted["blocks of trips that overlap, chained instead"] += len(overlapping)
    for block in overlapping:
        own = vehicle == block
        vehicle[own] = vehicle.max() + 1 + chain_at_terminals(trips[own])
    return np.asarray(pd.factorize(vehicle)[0], np.int64)


def _link_times(
    network: dict[str, pd.DataFrame],
    day_trips: pd.DataFrame,
    trips: pd.DataFrame,
    calls: Calls,
    counted: Counter[str],
) -> pd.DataFrame:
    """Return the table link_times: mean scheduled times by link and hour, at least those at 90 km/h."""
    begin = calls.first
    counts = np.diff(np.append(begin, len(calls.trip)))
    position = np.arange(len(calls.trip)) - np.repeat(begin, counts)
    pattern_first = np.flatnonzero(network["pattern_stops"]["seq0"] == 0)
    pattern = trips["pattern"].to_numpy()[calls.trip]
    link = network["pattern_stops"]["link"].to_numpy()[pattern_first[pattern] + position]
    metres = network["links"]["leg_m"].to_numpy(np.float64)
    leg = np.diff(calls.time, prepend=0.0)
    least = np.maximum(metres[np.where(position > 0, link, 0)] / MAX_SPEED_MPS, _MIN_LINK_S)
    counted["links scheduled faster than 90 km/h or in under 5 s, slowed"] += int(
        ((leg < least) & (position > 0)).sum()
    )
    leg = np.maximum(leg, least)
    where = np.zeros((2, len(trips)), np.int64)
    where[:, calls.trip[begin]] = begin, counts
    hours = _LAST_HOUR - _FIRST_HOUR + 1
    frames = []
    for day, part in day_trips.groupby("daytype", sort=False):
        first, count = where[:, part["trip"].to_numpy()]
        offset = np.cumsum(count) - count
        call = np.repeat(first - offset, count) + np.arange(count.sum())
        shift = np.repeat(part["shift"].to_numpy(), count)
        call, shift = call[position[call] > 0], shift[position[call] > 0]
        hour = np.clip((calls.time[call - 1] + shift) // 3600, _FIRST_HOUR, _LAST_HOUR).astype(np.int64)
        key = link[call] * hours + hour - _FIRST_HOUR
        total = np.bincount(key, leg[call], minlength=len(metres) * hours)
        count_here = np.bincount(key, minlength=len(metres) * hours)
        present = np.flatnonzero(count_here)
        frames.append(
            pd.DataFrame(
                {
                    "link": present // hours,
                    "hour": present % hours + _FIRST_HOUR,
                    "n": count_here[present],
                    "log_sigma": WITHIN_HOUR_SD,
                    "mean_s": total[present] / count_here[present],
                    "daytype": day,
                }
            )
        )
    return pd.concat(frames, ignore_index=True)


def _meta(
    feed: Feed,
    days: dict[str, tuple[dt.date, set[str]]],
    options: GtfsOptions,
    counted: Counter[str],
) -> dict[str, object]:
    """Return the metadata of the scenario."""
    agencies = sorted(set(feed["agency"]["agency_name"].dropna()))
    version = "".join(f", version {value}" for value in feed["feed_info"]["feed_version"].dropna()[:1])
    return {
        "source": f"GTFS feed {feed.path.name}{version}: {', '.join(agencies)}",
        "licence": "that of the feed; ask its publisher",
        "dates": {day: str(date) for day, (date, _) in days.items()},
        "made_up": {
            "demand, alighting": f"{options.boardings_per_trip:g} boardings per trip on weekdays, by shares "
            f"fitted to {SOURCE}; seed {options.seed}",
            "link_times.log_sigma": f"{WITHIN_HOUR_SD}, of {SOURCE}",
            "link_times.mean_s": "scheduled times, from which real means may differ",
        },
        "counted": {name: count for name, count in counted.items() if count},
        "link_times_include_dwell": True,
    }
