"""Network of the bus environment, built from a scenario's tables."""

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from headway.contracts import HeadwayError
from headway_envs.bus.config import BusConfig
from headway_envs.bus.kernel.layout import BIN_S, FIRST_KNOT_HOUR, KNOT_HOURS, KNOT_S, KNOTS, Network
from headway_envs.bus.scenario.measures import distance_m
from headway_envs.bus.scenario.tables import PERIOD_HOURS, Tables
from headway_envs.bus.scenario.timetable import (
    Departures,
    Trip,
    chain_trips,
    observed_departures,
    smooth_departures,
    work_until_depot,
)

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

_MAX_SD = 0.8
"""Upper bound applied to the sd of the log of link times. Hours with few observations have values up to 1.5,
which are taken for faults."""


def build(tables: Tables, config: BusConfig, replay: bool = False) -> tuple[Network, tuple[str, ...]]:
    """Return the network of the configured day type and the names of its lines.

    `replay`: trips leave at the departure times of the table, instead of evenly spread ones.

    Raises HeadwayError if the day type has no trips, demand or travel times.
    """
    day = config.day_type
    trips = trips_of_day(tables, config)
    lines = _patterns_by_line(tables, trips)
    patterns = [pattern for group in lines.values() for pattern in group]
    calls = calls_of(tables, patterns)
    call_counts = calls.groupby("p").size().to_numpy(np.int64)
    pattern_calls = _offsets(call_counts)
    spread = observed_departures if replay else smooth_departures
    departures = [
        spread(np.asarray(trips.loc[trips["pattern"] == p, "dep_s"], np.float64), KNOT_S) for p in patterns
    ]
    boarding = _hourly_boarding(tables, calls, day)
    alighting = _alighting(tables, calls)
    link_s, link_sd = _link_times(tables, calls, day)
    per_call, dwell = _mean_dwell(boarding, alighting, departures, pattern_calls, config)
    running, nominal = _running(link_s, dwell, pattern_calls, tables)
    line_patterns = _offsets(np.array([len(group) for group in lines.values()]))
    deadhead = _deadheads(tables, calls, pattern_calls, line_patterns)
    timetable = _timetable(departures, nominal, pattern_calls, line_patterns, deadhead, config)
    rates, regular = _rates(boarding, departures, nominal, pattern_calls, line_patterns, config)
    others = (1 - config.captive_share) * config.arrivals_per_boarding
    arrival_rate = rates * (config.captive_share + others)
    network = Network(
        line_slots=timetable["line_slots"].astype(np.int64),
        line_patterns=line_patterns,
        pattern_calls=pattern_calls,
        pattern_trips=timetable["pattern_trips"].astype(np.int64),
        trip_pattern=timetable["trip_pattern"].astype(np.int64),
        trip_departure=timetable["trip_departure"].astype(np.float64),
        trip_deadhead=timetable["trip_deadhead"].astype(np.float64),
        trip_work_left=timetable["trip_work_left"].astype(np.float64),
        slot_trips=timetable["slot_trips"].astype(np.int64),
        slot_first=timetable["slot_first"].astype(np.int64),
        slot_line=timetable["slot_line"].astype(np.int64),
        running=running,
        nominal=nominal,
        noise_sd=_remaining_sd(link_sd, config),
        alighting=alighting,
        arrival_rate=arrival_rate,
        boarding_rate=rates,
        regular_waiting=regular,
        target=np.array([d.headway for d in departures]),
        detour=_detours(tables, calls, config),
        queue_first=_queue_offsets(rates, per_call, config),
    )
    # Always the same memory layout: for another one, numba would compile the kernel again.
    arrays: list[Any] = [np.ascontiguousarray(array) for array in network]
    return Network(*arrays), tuple(lines)


def _offsets(counts: NDArray[Any]) -> Integers:
    return np.concatenate(([0], np.cumsum(counts))).astype(np.int64)


def trips_of_day(tables: Tables, config: BusConfig) -> pd.DataFrame:
    """Return the trips that leave within the configured service day.

    Raises HeadwayError if there are none.
    """
    trips = tables.trips[tables.trips["daytype"] == config.day_type]
    begin, end = config.start_hour * 3600.0, config.end_hour * 3600.0
    trips = trips[(trips["dep_s"] >= begin) & (trips["dep_s"] < end)]
    if trips.empty:
        raise HeadwayError(
            f"table trips has no trip of day_type {config.day_type} that leaves between {config.start_hour} "
            f"and {config.end_hour} h: choose another day_type or other hours"
        )
    return trips


def pattern_rows(tables: Tables, config: BusConfig) -> list[int]:
    """Return the number in the tables of each of the network's patterns.

    Raises HeadwayError if no trip leaves within the service day.
    """
    lines = _patterns_by_line(tables, trips_of_day(tables, config))
    return [pattern for group in lines.values() for pattern in group]


def _patterns_by_line(tables: Tables, trips: pd.DataFrame) -> dict[str, list[int]]:
    """Return the patterns with trips, by line, in the network's order."""
    running = tables.patterns[tables.patterns["pattern"].isin(trips["pattern"])]
    lines: dict[str, list[int]] = {}
    for line, group in running.sort_values(["line", "dir", "pattern"]).groupby("line", sort=False):
        lines[str(line)] = [int(p) for p in group["pattern"]]
    return lines


def calls_of(tables: Tables, patterns: Sequence[int]) -> pd.DataFrame:
    """Return one row per call (Q), pattern by pattern in the given order.

    Columns: p (index of the pattern), pattern, seq0, stop, link, lat, lon.
    """
    place = pd.Series(range(len(patterns)), index=list(patterns))
    calls = tables.pattern_stops[tables.pattern_stops["pattern"].isin(patterns)].copy()
    calls["p"] = place.reindex(calls["pattern"]).to_numpy()
    calls = calls.sort_values(["p", "seq0"]).merge(
        tables.stops[["stop", "lat", "lon"]], on="stop", how="left"
    )
    return calls.reset_index(drop=True)


def _call_index(calls: pd.DataFrame) -> pd.Series:
    """Return the index of each call, by pattern and seq0."""
    keys = pd.MultiIndex.from_frame(calls[["pattern", "seq0"]].astype(np.int64))
    return pd.Series(np.arange(len(calls)), index=keys)


def _rows_of_calls(calls: pd.DataFrame, frame: pd.DataFrame) -> tuple[pd.DataFrame, Integers]:
    """Return the rows of `frame` whose (pattern, seq0) is a call, and the index of that call."""
    keys = pd.MultiIndex.from_frame(frame[["pattern", "seq0"]].astype(np.int64))
    index = _call_index(calls).reindex(keys).to_numpy()
    known = ~np.isnan(index)
    return frame[known], index[known].astype(np.int64)


def _hourly_boarding(tables: Tables, calls: pd.DataFrame, day: str) -> Floats:
    """Return the number of passengers who board per hour (Q, K)."""
    frame, index = _rows_of_calls(calls, tables.demand[tables.demand["daytype"] == day])
    if frame.empty:
        raise HeadwayError(f"table demand has no rows of day_type {day}: add them or choose another day_type")
    boarding = np.zeros((len(calls), KNOTS))
    hour = frame["hour"].to_numpy(np.int64) - FIRST_KNOT_HOUR
    inside = (hour >= 0) & (hour < KNOTS)
    np.add.at(boarding, (index[inside], hour[inside]), frame["board"].to_numpy(float)[inside])
    return boarding


def _alighting(tables: Tables, calls: pd.DataFrame) -> Floats:
    """Return the alighting shares (Q, 4): 0 at the first call of a pattern, 1 at the last."""
    frame, index = _rows_of_calls(calls, tables.alighting)
    alighting = np.zeros((len(calls), 4))
    alighting[index, frame["period"].to_numpy(np.int64)] = frame["p_alight"].to_numpy(float)
    alighting[calls["seq0"].to_numpy() == 0] = 0.0
    last = calls["p"].to_numpy() != np.append(calls["p"].to_numpy()[1:], -1)
    alighting[last] = 1.0
    return alighting


def _link_times(tables: Tables, calls: pd.DataFrame, day: str) -> tuple[Floats, Floats]:
    """Return mean time (Q, K), s, and sd of its log (Q,) of the link that leads away from each call."""
    frame = tables.link_times[tables.link_times["daytype"] == day]
    away = np.append(calls["link"].to_numpy(np.int64)[1:], -1)
    inner = np.append(calls["seq0"].to_numpy()[1:] > 0, False)
    mean = frame.pivot_table(index="link", columns="hour", values="mean_s")
    first, last = int(KNOT_HOURS[0]), int(KNOT_HOURS[-1])
    mean = mean.reindex(columns=range(first, last + 1)).dropna(how="all")
    missing = inner & ~np.isin(away, mean.index)
    if missing.any():
        raise HeadwayError(
            f"table link_times has no row of link {away[missing][0]} on day_type {day} for an hour from "
            f"{first} to {last}: add its mean_s"
        )
    mean = mean.ffill(axis=1).bfill(axis=1)
    deviation = frame.groupby("link")["log_sigma"].median()
    seconds = np.zeros((len(calls), KNOTS))
    log_sd = np.zeros(len(calls))
    seconds[inner] = mean.reindex(away[inner]).to_numpy(float)
    log_sd[inner] = deviation.reindex(away[inner]).to_numpy(float)
    return seconds, log_sd


def _remaining_sd(link_sd: Floats, config: BusConfig) -> Floats:
    """Return the sd (Q,) of the link's travel-time factor, at least the floor.

    It is the measured variance minus the variances of trip, day, network, incidents and dwell.
    """
    noise = config.noise
    incidents = noise.incident_probability * math.log(max(noise.incident_factor, 1.0)) ** 2
    others = noise.trip_sd**2 + noise.day_sd**2 + noise.network_sd**2 + noise.dwell_sd**2 + incidents
    left = np.minimum(link_sd, _MAX_SD) ** 2 - others
    return np.sqrt(np.maximum(left, noise.link_floor_sd**2)) * (link_sd > 0)


def _mean_dwell(
    boarding: Floats,
    alighting: Floats,
    departures: Sequence[Departures],
    pattern_calls: Integers,
    config: BusConfig,
) -> tuple[Floats, Floats]:
    """Return the mean boardings per bus and call (Q, K), and the mean dwell there (Q, K), s.

    Mean loads are carried along the pattern. The fixed dwell counts with the Poisson probability that any
    passenger boards or alights.
    """
    per_call = np.zeros_like(boarding)
    dwell = np.zeros_like(boarding)
    periods = np.searchsorted(PERIOD_HOURS, KNOT_HOURS, side="right")
    for p, departing in enumerate(departures):
        first, last = pattern_calls[p], pattern_calls[p + 1]
        buses = 3600.0 / departing.headway
        load = np.zeros(KNOTS)
        for call in range(first, last):
            leaving = load * alighting[call, periods]
            entering = boarding[call] / buses if call < last - 1 else np.zeros(KNOTS)
            moving = 1.0 - np.exp(-(leaving + entering))
            per_call[call] = entering
            dwell[call] = (
                entering * config.boarding_s + leaving * config.alighting_s + moving * config.fixed_dwell_s
            )
            load = np.minimum(load - leaving + entering, config.capacity)
        dwell[first] = 0.0  # passengers board during the layover, before the planned departure
    return per_call, dwell


def _running(link_s: Floats, dwell: Floats, pattern_calls: Integers, tables: Tables) -> tuple[Floats, Floats]:
    """Return the running time to the next call (Q, K), and the nominal time since the first call (Q, K), s.

    If link times include the dwell at their start, it is subtracted, but at most half of the link time.
    """
    if tables.meta.get("link_times_include_dwell", True):
        running = np.maximum(link_s - dwell, 0.5 * link_s)
    else:
        running = link_s
    nominal = np.zeros_like(running)
    for first, last in pairwise(pattern_calls):
        for call in range(first + 1, last):
            # The hour of the link time advances with the bus.
            hours = (KNOT_S + nominal[call - 1] - KNOT_S[0]) / 3600.0
            knot = np.clip(hours.astype(np.int64), 0, KNOTS - 1)
            leg = running[call - 1, knot] + dwell[call - 1, knot]
            nominal[call] = nominal[call - 1] + leg
    return running, nominal


def _deadheads(
    tables: Tables, calls: pd.DataFrame, pattern_calls: Integers, line_patterns: Integers
) -> list[Floats]:
    """Return, per line, the times (patterns, patterns) from the end of each pattern to the start of each, s.

    Buses drive 1.3 times the straight-line distance at 20 km/h; 0 within 300 m.
    """
    lat, lon = calls["lat"].to_numpy(float), calls["lon"].to_numpy(float)
    ways = []
    for begin, end in pairwise(line_patterns):
        start, stop = pattern_calls[begin:end], pattern_calls[begin + 1 : end + 1] - 1
        metres = distance_m(lat[stop][:, None], lon[stop][:, None], lat[start][None], lon[start][None])
        ways.append(np.where(metres < 300.0, 0.0, 1.3 * metres / (20.0 / 3.6)))
    return ways


def _timetable(
    departures: Sequence[Departures],
    nominal: Floats,
    pattern_calls: Integers,
    line_patterns: Integers,
    deadhead: Sequence[Floats],
    config: BusConfig,
) -> dict[str, NDArray[np.float64] | Integers]:
    """Return the trips, sorted by pattern and departure, and the blocks of the slots, as network arrays."""
    trips: list[Trip] = []
    for p, departing in enumerate(departures):
        duration = np.interp(departing.times, KNOT_S, nominal[pattern_calls[p + 1] - 1])
        trips += [Trip(p, t, t + d) for t, d in zip(departing.times, duration, strict=True)]
    slots: list[list[int]] = []
    slot_line: list[int] = []
    before, work_left = np.zeros(len(trips)), np.zeros(len(trips))
    for line, (begin, end) in enumerate(pairwise(line_patterns)):
        mine = [i for i, trip in enumerate(trips) if begin <= trip.pattern < end]
        for driven in chain_trips([trips[i] for i in mine], deadhead[line], begin, config.recovery_share):
            block = [mine[i] for i in driven]
            for last, following in pairwise(block):
                before[following] = deadhead[line][
                    trips[last].pattern - begin, trips[following].pattern - begin
                ]
            work_left[block] = work_until_depot([trips[i] for i in block], config)
            slots.append(block)
            slot_line.append(line)
    return {
        "line_slots": _offsets(np.bincount(slot_line, minlength=len(deadhead))),
        "pattern_trips": _offsets(np.array([len(d.times) for d in departures])),
        "trip_pattern": np.array([trip.pattern for trip in trips]),
        "trip_departure": np.array([trip.departure for trip in trips]),
        "trip_deadhead": before,
        "trip_work_left": work_left,
        "slot_trips": np.array([i for block in slots for i in block]),
        "slot_first": _offsets(np.array([len(block) for block in slots])),
        "slot_line": np.array(slot_line),
    }


def _rates(
    boarding: Floats,
    departures: Sequence[Departures],
    nominal: Floats,
    pattern_calls: Integers,
    line_patterns: Integers,
    config: BusConfig,
) -> tuple[Floats, Floats]:
    """Return boarding rates (Q, B), passengers per s, and mean numbers of waiting passengers (L, B).

    Both are those of a regular service. Hourly numbers are interpolated between the middles of the hours.
    Passengers arrive by the timetable: from one headway before the first bus to the last bus. Of passengers
    with a competing service, a regular service leaves rate x xH (1 - x (1 - exp(-1/x))) waiting, where x is
    the competing share of the headway H.
    """
    bins = round(config.day_s / BIN_S + 0.499)
    middles = config.start_hour * 3600.0 + (np.arange(bins) + 0.5) * BIN_S
    rates = np.zeros((len(boarding), bins))
    regular = np.zeros((len(line_patterns) - 1, bins))
    x, per_boarding = config.competing_headway_share, config.arrivals_per_boarding
    others = (1 - config.captive_share) * per_boarding * x * (1 - 1 / per_boarding)
    for p, departing in enumerate(departures):
        line = int(np.searchsorted(line_patterns, p, side="right")) - 1
        headway = np.interp(middles, KNOT_S, departing.headway)
        for call in range(pattern_calls[p], pattern_calls[p + 1] - 1):
            rate = np.interp(middles, KNOT_S, boarding[call]) / 3600.0
            opens = departing.times[0] + np.interp(departing.times[0], KNOT_S, nominal[call])
            closes = departing.times[-1] + np.interp(departing.times[-1], KNOT_S, nominal[call])
            first_headway = np.interp(departing.times[0], KNOT_S, departing.headway)
            served = (middles >= opens - first_headway) & (middles <= closes)
            rates[call] = rate * served
            regular[line] += rates[call] * headway * (0.5 * config.captive_share + others)
    return rates, regular


def _detours(tables: Tables, calls: pd.DataFrame, config: BusConfig) -> Floats:
    """Return the driving time to the nearest service centre (Q,), s.

    Without centres in the metadata, the first stop of every twentieth pattern, and of at least one, has a
    centre.
    """
    lat, lon = calls["lat"].to_numpy(float), calls["lon"].to_numpy(float)
    centres = tables.meta.get("service_centres")
    if centres is None:
        firsts = np.flatnonzero(calls["seq0"].to_numpy() == 0)
        centres = [[lat[i], lon[i]] for i in firsts[::20]]
    try:
        places = np.array(centres, dtype=np.float64).reshape(-1, 2)
    except (TypeError, ValueError) as error:
        raise HeadwayError("meta.json: service_centres must be a list of [lat, lon]") from error
    if len(places) == 0:
        raise HeadwayError("meta.json: service_centres is empty; give at least one [lat, lon]")
    metres = distance_m(lat[:, None], lon[:, None], places[None, :, 0], places[None, :, 1]).min(axis=1)
    seconds = config.upkeep.detour_fixed_s + 1.3 * metres / (config.upkeep.detour_kmh / 3.6)
    return np.asarray(seconds, dtype=np.float64)


def _queue_offsets(rates: Floats, per_call: Floats, config: BusConfig) -> Integers:
    """Return the offsets of the queues' storage (Q + 1,).

    A queue has room for one bus load, three peak hours of boarding passengers, and passengers with a
    competing service.
    """
    peak = rates.max(axis=1) * 3.0 * 3600.0
    room = config.capacity + 24 + np.ceil(peak + 6.0 * per_call.max(axis=1)).astype(np.int64)
    return _offsets(room.astype(np.int64))
