"""Cleaned calls of a feed's trips: each has a stop with coordinates and a time."""

from collections import Counter
from dataclasses import dataclass

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from headway.contracts import HeadwayError
from headway_envs.bus.scenario.gtfs.feed import Feed, numbers, seconds
from headway_envs.bus.scenario.measures import distance_m

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

_DAY_S = 86_400.0


@dataclass(frozen=True)
class Calls:
    """Rows of stop_times, one trip after the other, each in driving order."""

    trip: Integers
    """(Q,) row of the trip in the frame of trips"""
    stop: Integers
    """(Q,) row of the stop in the frame of places"""
    time: Floats
    """(Q,) arrival time (at a trip's first call: departure time), s; increasing along a trip"""
    along: Floats
    """(Q,) sum of straight-line distances since the trip's first call, m"""

    @property
    def first(self) -> Integers:
        """Position of each trip's first call."""
        return np.flatnonzero(np.append(True, np.diff(self.trip) > 0))


def places(feed: Feed) -> tuple[pd.DataFrame, dict[str, int]]:
    """Return the stops with coordinates, with stops of one parent station merged.

    The results are the frame of stops (stop_id, name, lat, lon) and the row of each stop_id. Raises
    HeadwayError for impossible coordinates.
    """
    stops = feed["stops"].drop_duplicates("stop_id")
    latitudes = numbers("stops", "stop_lat", stops["stop_lat"])
    longitudes = numbers("stops", "stop_lon", stops["stop_lon"])
    stops = stops.set_index("stop_id")
    lat, lon = pd.Series(latitudes, stops.index), pd.Series(longitudes, stops.index)
    parent = stops["parent_station"].where(stops["parent_station"].isin(stops.index))
    own = parent.fillna(pd.Series(stops.index, stops.index))
    known = ~(lat.reindex(own).isna() | lon.reindex(own).isna()).to_numpy()
    own = own.where(known, pd.Series(stops.index, stops.index))  # a station needs coordinates to merge stops
    usable = ~(lat.reindex(own).isna() | lon.reindex(own).isna()).to_numpy()
    names = pd.unique(own[usable])
    frame = pd.DataFrame(
        {
            "stop_id": names,
            "name": stops["stop_name"].reindex(names).fillna("").to_numpy(),
            "lat": lat.reindex(names).to_numpy(),
            "lon": lon.reindex(names).to_numpy(),
        }
    )
    wrong = ~(frame["lat"].between(-90, 90) & frame["lon"].between(-180, 180))
    if wrong.any():
        raise HeadwayError(
            f"stops.txt: stop {frame['stop_id'][wrong].iloc[0]} lies nowhere on Earth; correct it"
        )
    row = {name: i for i, name in enumerate(names)}
    return frame, {str(stop): row[name] for stop, name in own[usable].items()}


def clean_calls(
    feed: Feed, trips: pd.DataFrame, stops: pd.DataFrame, rows: dict[str, int]
) -> tuple[Calls, Counter[str]]:
    """Return the calls of `trips` (trip_id), and the number of irregularities of each kind.

    Raises HeadwayError if no trip has two calls with times.
    """
    counted: Counter[str] = Counter()
    frame = _unwrap_midnight(_drop_unplaced_calls(_stop_time_rows(feed, trips, rows), counted), counted)
    frame = _drop_incomplete_trips(frame, len(trips), counted)
    if frame.empty:
        raise HeadwayError(
            f"{feed.path}: no trip of the chosen days has two calls with times; check stop_times.txt"
        )
    trip, stop = frame["trip"].to_numpy(np.int64), frame["stop"].to_numpy(np.int64)
    time, shape = frame["time"].to_numpy(np.float64).copy(), frame["shape"].to_numpy(np.float64)
    begins = np.append(True, np.diff(trip) > 0)
    ends = np.append(begins[1:], True)
    along = _sum_along_trip(_leg_metres(stops, stop) * ~begins, begins)
    counted["times blank, set by distance"] += int(np.isnan(time).sum())
    decreasing = _decreasing(time, trip)
    counted["times before the previous one, set by distance"] += int(decreasing.sum())
    time[decreasing] = np.nan
    known = ~np.isnan(time)
    same = _repeated(time, known, trip, ends)
    counted["times equal to the previous one, spread by distance"] += int(same.sum())
    shape = _scale_to_metres(shape, along, begins)
    way = np.where(_has_complete_shape(shape, trip, begins, len(trips))[trip], shape, along)
    legs = np.append(0.0, np.diff(way))
    legs[begins] = 0.0
    time = _interpolate_times(time, known & ~same, trip, _sum_along_trip(legs + 1.0, begins))
    return Calls(trip, stop, time, along), counted


def _stop_time_rows(feed: Feed, trips: pd.DataFrame, rows: dict[str, int]) -> pd.DataFrame:
    """Return the rows of stop_times of `trips`, sorted by trip and sequence.

    Columns: trip, stop (-1: without coordinates), sequence, time, departure, shape.
    """
    times = feed["stop_times"]
    which = pd.Index(trips["trip_id"]).get_indexer(pd.Index(times["trip_id"]))
    times = times[which >= 0]
    codes, names = pd.factorize(times["stop_id"])
    places_of = np.array([*(rows.get(str(name), -1) for name in names), -1], np.int64)
    arrival = seconds("stop_times", "arrival_time", times["arrival_time"])
    departure = seconds("stop_times", "departure_time", times["departure_time"])
    frame = pd.DataFrame(
        {
            "trip": which[which >= 0].astype(np.int64),
            "stop": places_of[codes],
            "sequence": numbers("stop_times", "stop_sequence", times["stop_sequence"]),
            "time": np.where(np.isnan(arrival), departure, arrival),
            "departure": departure,
            "shape": numbers("stop_times", "shape_dist_traveled", times["shape_dist_traveled"]),
        }
    )
    frame = frame.iloc[np.lexsort((frame["sequence"], frame["trip"]))].reset_index(drop=True)
    # A trip begins when it leaves its first stop, not when the bus arrives there.
    leaves = ~frame["trip"].duplicated() & frame["departure"].notna()
    return frame.assign(time=frame["time"].where(~leaves, frame["departure"]))


def _drop_unplaced_calls(frame: pd.DataFrame, counted: Counter[str]) -> pd.DataFrame:
    """Drop calls at stops without coordinates, duplicate calls, and repeated calls at the same place."""
    lost = frame["stop"] < 0
    counted["calls at stops without a place, left out"] += int(lost.sum())
    twice = frame.duplicated(["trip", "sequence"])
    counted["calls given twice, the second left out"] += int(twice.sum())
    frame = frame[~lost & ~twice]
    again = (frame["trip"].diff() == 0) & (frame["stop"].diff() == 0)
    counted["calls at the same stop or station in a row, the second left out"] += int(again.sum())
    kept: pd.DataFrame = frame[~again]
    return kept


def _unwrap_midnight(frame: pd.DataFrame, counted: Counter[str]) -> pd.DataFrame:
    """Add 24 h where a trip's times fall by over 12 h, until they rise by over 12 h again.

    After 23:58 some feeds write 00:10 for 24:10.
    """
    timed = frame[frame["time"].notna()]
    step = timed["time"].diff().where(timed["trip"].diff() == 0, 0.0)
    midnights = (step < -0.5 * _DAY_S).astype(np.int64) - (step > 0.5 * _DAY_S)
    days = midnights.groupby(timed["trip"]).cumsum().clip(lower=0)
    counted["times after midnight written from 0 h on, 24 h added"] += int((days > 0).sum())
    return frame.assign(time=frame["time"] + _DAY_S * days.reindex(frame.index, fill_value=0))


def _drop_incomplete_trips(frame: pd.DataFrame, count: int, counted: Counter[str]) -> pd.DataFrame:
    """Keep only trips of at least two calls, with times at both ends that do not decrease."""
    trip = frame["trip"].to_numpy()
    begins, finishes = ~frame["trip"].duplicated(), ~frame["trip"].duplicated(keep="last")
    ends = begins | finishes
    timeless = np.zeros(count, np.bool_)
    timeless[trip[(ends & frame["time"].isna()).to_numpy()]] = True
    counted["trips without a time at an end, left out"] += int(timeless.sum())
    short = np.bincount(trip, minlength=count) < 2
    counted["trips of fewer than two calls, left out"] += int((short & ~timeless).sum())
    lasting = np.zeros(count)
    lasting[trip[begins.to_numpy()]] = frame["time"][finishes].to_numpy() - frame["time"][begins].to_numpy()
    backwards = lasting < 0
    counted["trips that end before they begin, left out"] += int((backwards & ~short).sum())
    kept: pd.DataFrame = frame[~(timeless | short | backwards)[trip]]
    return kept


def _leg_metres(stops: pd.DataFrame, stop: Integers) -> Floats:
    """Return the straight-line distance from the previous call (Q,), m."""
    lat, lon = stops["lat"].to_numpy()[stop], stops["lon"].to_numpy()[stop]
    return distance_m(lat, lon, np.append(lat[0], lat[:-1]), np.append(lon[0], lon[:-1]))


def _sum_along_trip(leg: Floats, begins: NDArray[np.bool_]) -> Floats:
    """Return cumulative sums along each trip (Q,), 0 at its first call."""
    total = np.cumsum(leg)
    return np.asarray(total - total[begins][np.cumsum(begins) - 1], np.float64)


def _scale_to_metres(shape: Floats, along: Floats, begins: NDArray[np.bool_]) -> Floats:
    """Return shape_dist_traveled since each trip's first call (Q,), scaled to straight-line metres.

    The feed may use any unit. NaN for trips where the distance does not increase overall.
    """
    trip = np.cumsum(begins) - 1
    last = np.append(np.flatnonzero(begins)[1:], len(begins)) - 1
    since = shape - shape[begins][trip]
    total = np.where(since[last] > 0, since[last], np.nan)
    return np.asarray(since * (along[last] / total)[trip], np.float64)


def _has_complete_shape(
    shape: Floats, trip: Integers, begins: NDArray[np.bool_], count: int
) -> NDArray[np.bool_]:
    """Return whether shape_dist_traveled of each trip (trips,) is complete and never decreases."""
    good = np.ones(count, np.bool_)
    good[trip[np.isnan(shape)]] = False
    fall = (np.diff(shape, prepend=np.inf) < 0) & ~begins
    good[trip[fall]] = False
    return good


def _decreasing(time: Floats, trip: Integers) -> NDArray[np.bool_]:
    """Return which times lie before an earlier time of their trip or after its last time.

    The first and last times of a trip are kept.
    """
    shifted = np.where(np.isnan(time), -np.inf, time) + trip * 1e7
    highest = np.maximum.accumulate(shifted)
    last = np.append(np.diff(trip) > 0, True)
    latest = np.repeat(time[last], np.diff(np.append(-1, np.flatnonzero(last))))
    first = np.append(True, np.diff(trip) > 0)
    return np.asarray(~np.isnan(time) & ~first & ~last & ((shifted < highest) | (time > latest)), np.bool_)


def _repeated(
    time: Floats, known: NDArray[np.bool_], trip: Integers, ends: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """Return which known times repeat the previous known time of their trip.

    A trip's last time is kept even if it repeats: the earlier calls with the same time are marked instead,
    except the trip's first.
    """
    where = np.flatnonzero(known)
    repeats = np.append(False, (np.diff(time[where]) <= 0) & (np.diff(trip[where]) == 0))
    same = np.zeros(len(time), np.bool_)
    same[where[repeats]] = True
    for last in np.flatnonzero(ends & same):
        same[last] = False
        # Instead, mark the earlier calls with the same time, except the trip's first.
        call = last - 1
        while trip[call] == trip[last] and (not known[call] or time[call] >= time[last]):
            same[call] = known[call]
            call -= 1
        if call < 0 or trip[call] != trip[last]:
            same[call + 1] = False
    return same


def _interpolate_times(time: Floats, fixed: NDArray[np.bool_], trip: Integers, way: Floats) -> Floats:
    """Interpolate times between the fixed ones by distance. Both ends of each trip must be fixed."""
    place = way + trip * 1e8
    return np.asarray(np.interp(place, place[fixed], time[fixed]), np.float64)
