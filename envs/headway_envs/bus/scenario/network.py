"""Network of the bus environment, built from a scenario's tables."""

import math
import shlex
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from headway.contracts import HeadwayError
from headway_envs.bus.config import FIRST_HOUR, LAST_HOUR, BusConfig, service_hours
from headway_envs.bus.kernel.layout import BIN_S, FIRST_KNOT_HOUR, KNOT_HOURS, KNOT_S, KNOTS, Network
from headway_envs.bus.scenario.measures import distance_m
from headway_envs.bus.scenario.tables import PERIOD_HOURS, Columns, Tables
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
_MAX_CALLS = 1001
"""Largest number of calls of a pattern."""


def build(tables: Tables, config: BusConfig, replay: bool = False) -> tuple[Network, tuple[str, ...]]:
    """Return the network of the configured day type and the names of its lines.

    `replay`: trips leave at the departure times of the table, instead of evenly spread ones.

    Raises HeadwayError if the day type has no trips, demand or travel times.
    """
    return build_from_arrays(tables.arrays(), tables.meta, config, replay)


def build_from_arrays(
    tables: Mapping[str, Columns], meta: Mapping[str, Any], config: BusConfig, replay: bool = False
) -> tuple[Network, tuple[str, ...]]:
    """Return what `build` returns for the same tables as arrays (`Tables.arrays`) and their metadata."""
    day = config.day_type
    trips = trips_of_day(tables, config)
    lines = _patterns_by_line(tables, trips)
    patterns = [pattern for group in lines.values() for pattern in group]
    calls = calls_of(tables, patterns)
    pattern_calls = _offsets(np.bincount(calls["p"]))
    spread = observed_departures if replay else smooth_departures
    departures = [
        spread(np.asarray(trips["dep_s"][trips["pattern"] == p], np.float64), KNOT_S) for p in patterns
    ]
    boarding = _hourly_boarding(tables, calls, day)
    alighting = _alighting(tables, calls)
    link_s, link_sd = _link_times(tables, calls, day)
    per_call, dwell = _mean_dwell(boarding, alighting, departures, pattern_calls, config)
    running, nominal = _running(link_s, dwell, pattern_calls, meta)
    line_patterns = _offsets(np.array([len(group) for group in lines.values()]))
    deadhead = _deadheads(calls, pattern_calls, line_patterns)
    timetable = _timetable(departures, nominal, pattern_calls, line_patterns, deadhead, config)
    rates, regular = _rates(boarding, departures, nominal, pattern_calls, line_patterns, config)
    others = (1 - config.captive_share) * config.arrivals_per_boarding
    surge = _surge(calls, rates.shape[1], config)
    arrival_rate = rates * (config.captive_share + others) * surge
    detour = _detours(meta, calls, config)
    network = Network(
        line_slots=timetable["line_slots"].astype(np.int64),
        line_patterns=line_patterns,
        pattern_calls=pattern_calls,
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
        slowness=_slowness(calls, pattern_calls, config),
        detour=detour,
        line_trip=np.maximum.reduceat(nominal.max(axis=1), pattern_calls[line_patterns[:-1]]),
        line_detour=np.minimum.reduceat(detour[pattern_calls[:-1]], line_patterns[:-1]),
        queue_first=_queue_offsets(rates * surge, per_call, config),
    )
    _check_buses(len(network.slot_line), config)
    # Always the same memory layout: for another one, numba would compile the kernel again.
    arrays: list[Any] = [np.ascontiguousarray(array) for array in network]
    return Network(*arrays), tuple(lines)


def _offsets(counts: NDArray[Any]) -> Integers:
    return np.concatenate(([0], np.cumsum(counts))).astype(np.int64)


def _select(table: Columns, rows: NDArray[Any]) -> Columns:
    """Return the rows of a table, given by number or by truth value."""
    return {name: values[rows] for name, values in table.items()}


def _rows_of(keys: NDArray[Any], wanted: NDArray[Any]) -> Integers:
    """Return the place in `keys` of each wanted key; -1 if it is not there."""
    if not len(keys):
        return np.full(len(wanted), -1)
    order = np.argsort(keys, kind="stable")
    found = order[np.minimum(np.searchsorted(keys, wanted, sorter=order), len(keys) - 1)]
    return np.where(keys[found] == wanted, found, -1)


def trips_of_day(tables: Mapping[str, Columns], config: BusConfig) -> Columns:
    """Return the trips that leave within the configured service day.

    Raises HeadwayError if there are none.
    """
    trips = tables["trips"]
    hour = trips["dep_s"] // 3600.0
    own = trips["daytype"] == config.day_type
    leaves = own & (hour >= config.start_hour) & (hour < config.end_hour)
    if not leaves.any():
        able = own & (hour >= FIRST_HOUR) & (hour < LAST_HOUR)
        fix = f"set env.args.day_type={trips['daytype'][0]}"
        if able.any():
            first_s, last_s = trips["dep_s"][able].min(), trips["arr_s"][able].max()
            start, end = service_hours(first_s / 3600.0, last_s / 3600.0)
            fix = f"set env.args.start_hour={start} env.args.end_hour={end}"
        elif own.any():
            fix = f"correct dep_s, because only {FIRST_HOUR} to {LAST_HOUR} h can be simulated"
        raise HeadwayError(
            f"table trips has no trip of day_type {config.day_type} that leaves between {config.start_hour} "
            f"and {config.end_hour} h: {fix}"
        )
    return _select(trips, leaves)


def pattern_rows(tables: Mapping[str, Columns], config: BusConfig) -> list[int]:
    """Return the tables' `pattern` number of each pattern of the network, in its order.

    Raises HeadwayError if no trip leaves within the service day.
    """
    lines = _patterns_by_line(tables, trips_of_day(tables, config))
    return [pattern for group in lines.values() for pattern in group]


def _patterns_by_line(tables: Mapping[str, Columns], trips: Columns) -> dict[str, list[int]]:
    """Return the patterns with trips, by line, in the network's order."""
    running = _select(tables["patterns"], np.isin(tables["patterns"]["pattern"], trips["pattern"]))
    lines: dict[str, list[int]] = {}
    columns = (running[name].tolist() for name in ("line", "dir", "pattern"))
    for line, _, pattern in sorted(zip(*columns, strict=True)):
        lines.setdefault(str(line), []).append(int(pattern))
    return lines


def calls_of(tables: Mapping[str, Columns], patterns: Sequence[int]) -> Columns:
    """Return one row per call (Q), pattern by pattern in the given order.

    Columns: p (index of the pattern), pattern, seq0, stop, link, lat, lon.
    """
    calls, stops = tables["pattern_stops"], tables["stops"]
    p = _rows_of(np.array(patterns), calls["pattern"])
    order = np.lexsort((calls["seq0"], p))
    order = order[p[order] >= 0]
    place = _rows_of(stops["stop"], calls["stop"][order])
    coordinates = {name: stops[name][place].astype(np.float64) for name in ("lat", "lon")}
    return {"p": p[order], **_select(calls, order), **coordinates}


def _rows_of_calls(calls: Columns, table: Columns) -> tuple[Columns, Integers]:
    """Return the rows of `table` whose (pattern, seq0) is a call, and the index of that call."""
    keys, wanted = (
        each["pattern"].astype(np.int64) * _MAX_CALLS + each["seq0"].astype(np.int64)
        for each in (calls, table)
    )
    index = _rows_of(keys, wanted)
    return _select(table, index >= 0), index[index >= 0]


def _hourly_boarding(tables: Mapping[str, Columns], calls: Columns, day: str) -> Floats:
    """Return the number of passengers who board per hour (Q, K)."""
    demand = tables["demand"]
    rows, index = _rows_of_calls(calls, _select(demand, demand["daytype"] == day))
    if not len(index):
        raise HeadwayError(f"table demand has no rows of day_type {day}: add them or choose another day_type")
    boarding = np.zeros((len(calls["p"]), KNOTS))
    hour = rows["hour"].astype(np.int64) - FIRST_KNOT_HOUR
    inside = (hour >= 0) & (hour < KNOTS)
    np.add.at(boarding, (index[inside], hour[inside]), rows["board"].astype(np.float64)[inside])
    return boarding


def _alighting(tables: Mapping[str, Columns], calls: Columns) -> Floats:
    """Return the alighting shares (Q, 4): 0 at the first call of a pattern, 1 at the last."""
    rows, index = _rows_of_calls(calls, tables["alighting"])
    alighting = np.zeros((len(calls["p"]), 4))
    alighting[index, rows["period"].astype(np.int64)] = rows["p_alight"]
    alighting[calls["seq0"] == 0] = 0.0
    alighting[calls["p"] != np.append(calls["p"][1:], -1)] = 1.0
    return alighting


def _link_times(tables: Mapping[str, Columns], calls: Columns, day: str) -> tuple[Floats, Floats]:
    """Return mean time (Q, K), s, and sd of its log (Q,) of the link that leads away from each call.

    Hours without a time take that of the hour before, and the first ones that of the first hour with one.
    """
    times = _select(tables["link_times"], tables["link_times"]["daytype"] == day)
    links, row = np.unique(times["link"].astype(np.int64), return_inverse=True)
    knot = times["hour"].astype(np.int64) - FIRST_KNOT_HOUR
    inside = (knot >= 0) & (knot < KNOTS)
    mean = np.full((len(links), KNOTS), np.nan)
    mean[row[inside], knot[inside]] = times["mean_s"][inside]
    known = ~np.isnan(mean)
    away = np.append(calls["link"].astype(np.int64)[1:], -1)
    inner = np.append(calls["seq0"][1:] > 0, False)
    missing = inner & ~np.isin(away, links[known.any(axis=1)])
    if missing.any():
        raise HeadwayError(
            f"table link_times has no row of link {away[missing][0]} on day_type {day} for an hour from "
            f"{KNOT_HOURS[0]} to {KNOT_HOURS[-1]}: add its mean_s"
        )
    latest = np.maximum.accumulate(np.where(known, np.arange(KNOTS), -1), axis=1)
    mean = np.take_along_axis(mean, np.where(latest < 0, known.argmax(axis=1)[:, None], latest), axis=1)
    seconds = np.zeros((len(away), KNOTS))
    log_sd = np.zeros(len(away))
    link = _rows_of(links, away[inner])
    seconds[inner] = mean[link]
    log_sd[inner] = _medians(times["log_sigma"].astype(np.float64), row)[link]
    return seconds, log_sd


def _medians(values: Floats, group: Integers) -> Floats:
    """Return the median of the values of each group; groups are numbered from 0."""
    ordered, counts = values[np.lexsort((values, group))], np.bincount(group)
    first = _offsets(counts)[:-1]
    return np.asarray(0.5 * (ordered[first + (counts - 1) // 2] + ordered[first + counts // 2]), np.float64)


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


def _running(
    link_s: Floats, dwell: Floats, pattern_calls: Integers, meta: Mapping[str, Any]
) -> tuple[Floats, Floats]:
    """Return the running time to the next call (Q, K), and the nominal time since the first call (Q, K), s.

    If link times include the dwell at their start, it is subtracted, but at most half of the link time.
    """
    if meta.get("link_times_include_dwell", True):
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


def _deadheads(calls: Columns, pattern_calls: Integers, line_patterns: Integers) -> list[Floats]:
    """Return, per line, the times (patterns, patterns) from the end of each pattern to the start of each, s.

    Buses drive 1.3 times the straight-line distance at 20 km/h; 0 within 300 m.
    """
    lat, lon = calls["lat"], calls["lon"]
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


def _detours(meta: Mapping[str, Any], calls: Columns, config: BusConfig) -> Floats:
    """Return the driving time to the nearest service centre (Q,), s.

    Without centres in the metadata, the first stop of every twentieth pattern, and of at least one, has a
    centre.
    """
    lat, lon = calls["lat"], calls["lon"]
    centres = meta.get("service_centres")
    if centres is None:
        firsts = np.flatnonzero(calls["seq0"] == 0)
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


def _at_stops(calls: Columns, config: BusConfig, key: str) -> NDArray[np.bool_]:
    """Return whether each call (Q,) is at one of the stops of a disruption; all calls without stops.

    Raises HeadwayError for a stop without calls.
    """
    stops = getattr(config.disruptions, key)
    for stop in stops:
        if stop not in calls["stop"]:
            scenario = shlex.quote(str(config.scenario))
            numbers = f"headway data describe {scenario} --day-type {config.day_type} --stops 5000"
            raise HeadwayError(
                f"env.args.disruptions.{key}: no trip calls at stop {stop}; `{numbers}` shows the numbers "
                f"of the stops, such as {calls['stop'][0]}"
            )
    return np.isin(calls["stop"], stops) if stops else np.ones(len(calls["stop"]), np.bool_)


def _surge(calls: Columns, bins: int, config: BusConfig) -> Floats:
    """Return the factor of the configured surge on passenger arrivals (Q, B)."""
    disruptions = config.disruptions
    begins = config.start_hour + np.arange(bins) * BIN_S / 3600.0
    during = (begins >= disruptions.surge_hour) & (begins < disruptions.surge_hour + 1)
    there = _at_stops(calls, config, "surge_stops")
    return np.where(there[:, None] & during, disruptions.surge, 1.0)


def _slowness(calls: Columns, pattern_calls: Integers, config: BusConfig) -> Floats:
    """Return the factor on the travel time to the next call (Q,) during the hour of slow links."""
    disruptions = config.disruptions
    there = _at_stops(calls, config, "slow_stops")
    if not disruptions.slow_stops:
        there[:] = False
        # The link in the middle of each pattern, of its calls - 1 links.
        there[(pattern_calls[:-1] + pattern_calls[1:] - 1) // 2] = True
    return np.where(there, disruptions.slow, 1.0)


def _check_buses(slots: int, config: BusConfig) -> None:
    """Raise HeadwayError if a disruption names a bus that the scenario does not have."""
    for key in ("breakdown_bus", "late_bus"):
        bus = getattr(config.disruptions, key)
        if bus >= slots:
            raise HeadwayError(
                f"env.args.disruptions.{key}: there is no bus {bus}; the scenario has {slots}, from 0"
            )


def _queue_offsets(rates: Floats, per_call: Floats, config: BusConfig) -> Integers:
    """Return the offsets of the queues' storage (Q + 1,).

    A queue has room for one bus load, three peak hours of boarding passengers, and passengers with a
    competing service.
    """
    peak = rates.max(axis=1) * 3.0 * 3600.0
    room = config.capacity + 24 + np.ceil(peak + 6.0 * per_call.max(axis=1)).astype(np.int64)
    return _offsets(room.astype(np.int64))
