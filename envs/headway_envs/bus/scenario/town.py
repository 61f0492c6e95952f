"""Synthetic scenarios of many lines that share stops and links: a district and a city."""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.special import ndtri

from headway.contracts import generator
from headway_envs.bus.config import BusConfig
from headway_envs.bus.kernel.layout import KNOT_HOURS, KNOT_S, KNOTS
from headway_envs.bus.scenario.fitted import (
    BOARDINGS_PER_TRIP,
    DEPARTURES,
    LINE_BOARDINGS_PER_TRIP,
    ONE_WAY_SHARE,
    SOURCE,
    SUNDAY_FLEET,
    SUNDAY_LINES,
    SYNTHETIC,
)
from headway_envs.bus.scenario.link_times import fitted_link_times
from headway_envs.bus.scenario.measures import METRES_PER_DEGREE, TIMED_HOURS
from headway_envs.bus.scenario.passengers import synthetic_passengers
from headway_envs.bus.scenario.streets import LineLayout, lay_out_lines
from headway_envs.bus.scenario.tables import NO_LINK, Tables
from headway_envs.bus.scenario.timetable import Trip, chain_trips, smooth_departures

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

LINES = {"district": 40, "city": 382}
"""Number of lines."""
SITES = {"district": 560, "city": 1425}
"""Number of pairs of stops. In SUNT, 382 lines call at 2,850 stops, and the 40 busiest at 1,118."""
FLEETS = {"district": 440, "city": 1359}
"""Number of buses in service at the weekday peak: on SUNT's 40 busiest lines, and on all its lines."""
FLEET_SD = {"district": 0.38, "city": 0.83}
"""Sd of the log of the number of buses per line at the peak: SUNT's 40 busiest lines, and all its lines."""
MAX_FLEET = 25
"""Number of buses at once on SUNT's busiest line."""
SERVICE_SD = 0.5
"""Assumption: sd of the log of departures between lines of the same length, by which fleets are assigned."""
_STOPS = {"district": (8, 76), "city": (5, 90)}
"""Smallest and largest number of stops of a pattern: of SUNT's 40 busiest lines, and of all its lines."""
_LAT, _LON = -12.97, -38.50
"""Position of Salvador, degrees."""
_ALLOWANCE = 1.05
"""Assumption: planned link times over mean ones, for the dwell at busy stops that link times do not
include."""


def generate_town(size: str, seed: int, after_line: Callable[[], None]) -> Tables:
    """Return the tables of `district` or `city`.

    The fleets of the lines are the same for all seeds. `after_line` is called once per line.
    """
    rng = generator(seed, "bus town", 0)
    fleets = line_fleets(size)
    one_way = [False] * len(fleets)
    for line in rng.choice(len(fleets), round(ONE_WAY_SHARE * len(fleets)), replace=False):
        one_way[line] = True
    layout = _order_by_service(rng, lay_out_lines(rng, SITES[size], one_way, _STOPS[size]))
    tables = _geometry(rng, layout)
    names = tables["patterns"]["line"]
    of_line = [np.flatnonzero(names == name) for name in names.unique()]
    times = _link_seconds(tables)
    trips = _trips(fleets, of_line, {day: _durations(tables, times[day]) for day in times}, after_line)
    middle, sd = LINE_BOARDINGS_PER_TRIP
    level = middle * rng.lognormal(0.0, sd, len(fleets))
    line_of = np.concatenate([np.full(len(own), line) for line, own in enumerate(of_line)])
    per_trip = {
        day: dict(enumerate((level[line_of] * mean / BOARDINGS_PER_TRIP["weekday"]).tolist()))
        for day, mean in BOARDINGS_PER_TRIP.items()
    }
    demand, alighting = synthetic_passengers(tables["pattern_stops"], trips, per_trip, seed)
    meta = {
        "source": f"{SYNTHETIC}, by numbers fitted to {SOURCE}",
        "size": size,
        "seed": seed,
        "link_times_include_dwell": True,
    }
    return Tables(**tables, demand=demand, alighting=alighting, trips=trips, meta=meta)


def line_fleets(size: str) -> list[int]:
    """Return the number of buses at once on each line at the weekday's peak, in decreasing order.

    They are quantiles of the fitted lognormal, scaled until they sum to the fleet of the size.
    """
    count, total = LINES[size], FLEETS[size]
    shape = np.exp(FLEET_SD[size] * ndtri((np.arange(count)[::-1] + 0.5) / count))
    low, high = 0.0, float(MAX_FLEET)
    for _ in range(60):
        middle = 0.5 * (low + high)
        fleets = np.clip(np.round(middle * shape), 1, MAX_FLEET)
        low, high = (middle, high) if fleets.sum() < total else (low, middle)
    fleets = np.clip(np.round(high * shape), 1, MAX_FLEET).astype(np.int64)
    # Rounding leaves a few buses too many: one each is taken from medium-sized lines.
    for line in range(int(fleets.sum()) - total):
        fleets[count // 4 + line] -= 1
    return [int(buses) for buses in fleets]


def _order_by_service(rng: np.random.Generator, layout: LineLayout) -> LineLayout:
    """Order lines by their number of stops times a random level of service, largest first.

    The first lines get the most buses.
    """
    calls = np.array([sum(len(stops) for stops in line) for line in layout.lines])
    order = np.argsort(-calls * rng.lognormal(0.0, SERVICE_SD, len(calls)))
    return replace(layout, lines=tuple(layout.lines[line] for line in order))


def _geometry(rng: np.random.Generator, layout: LineLayout) -> dict[str, pd.DataFrame]:
    """Return the tables stops, patterns, pattern_stops, links and link_times."""
    patterns = [
        (f"line{i:03d}", "IV"[way], stops)
        for i, line in enumerate(layout.lines)
        for way, stops in enumerate(line)
    ]
    used = np.unique(np.concatenate([stops for _, _, stops in patterns]))
    counts = np.array([len(stops) for _, _, stops in patterns])
    calls = pd.DataFrame(
        {
            "pattern": np.repeat(np.arange(len(patterns)), counts),
            "seq0": np.concatenate([np.arange(count) for count in counts]),
            "stop": np.searchsorted(used, np.concatenate([stops for _, _, stops in patterns])),
        }
    )
    stops = pd.DataFrame(
        {
            "stop": np.arange(len(used)),
            "lat": _LAT + layout.y[used] / METRES_PER_DEGREE,
            "lon": _LON + layout.x[used] / (METRES_PER_DEGREE * math.cos(math.radians(_LAT))),
        }
    )
    inner = calls["seq0"].to_numpy() > 0
    pairs = np.column_stack((calls["stop"].shift(fill_value=0), calls["stop"]))[inner]
    ends, link_of = np.unique(pairs, axis=0, return_inverse=True)
    metres = np.hypot(*(place[used[ends[:, 1]]] - place[used[ends[:, 0]]] for place in (layout.x, layout.y)))
    metres = np.maximum(np.round(metres), 1.0)
    calls["link"] = NO_LINK
    calls.loc[inner, "link"] = link_of.ravel()
    calls["leg_m"] = 0.0
    calls.loc[inner, "leg_m"] = metres[link_of.ravel()]
    return {
        "stops": stops,
        "patterns": pd.DataFrame(
            {
                "pattern": np.arange(len(patterns)),
                "line": [line for line, _, _ in patterns],
                "dir": [way for _, way, _ in patterns],
                "n_stops": counts,
                "length_m": calls.groupby("pattern")["leg_m"].sum().to_numpy(),
            }
        ),
        "pattern_stops": calls,
        "links": pd.DataFrame(
            {"link": np.arange(len(ends)), "from_stop": ends[:, 0], "to_stop": ends[:, 1], "leg_m": metres}
        ),
        "link_times": pd.DataFrame(fitted_link_times(rng, np.arange(len(metres)), metres)),
    }


def _link_seconds(tables: dict[str, pd.DataFrame]) -> dict[str, Floats]:
    """Return link times at the knots (links, K) by day type, s.

    Before and after TIMED_HOURS they are constant.
    """
    found = {}
    for day, rows in tables["link_times"].groupby("daytype"):
        by_hour = rows["mean_s"].to_numpy(np.float64).reshape(-1, len(TIMED_HOURS))
        found[str(day)] = by_hour[:, np.clip(KNOT_HOURS - TIMED_HOURS[0], 0, len(TIMED_HOURS) - 1)]
    return found


def _durations(tables: dict[str, pd.DataFrame], seconds: Floats) -> list[Floats]:
    """Return per pattern the planned duration of a trip that leaves at each knot (K,), s.

    The hour of the link times advances with the bus.
    """
    calls = tables["pattern_stops"]
    links, first = calls["link"].to_numpy(), np.flatnonzero(calls["seq0"] == 0)
    durations = []
    for begin, end in pairwise([*first.tolist(), len(calls)]):
        passed = np.zeros(KNOTS)
        for link in links[begin + 1 : end]:
            hour = np.clip((np.arange(KNOTS) + passed / 3600.0).astype(np.int64), 0, KNOTS - 1)
            passed = passed + _ALLOWANCE * seconds[link, hour]
        durations.append(passed)
    return durations


def _trips(
    fleets: Sequence[int],
    of_line: Sequence[Integers],
    durations: dict[str, list[Floats]],
    after_line: Callable[[], None],
) -> pd.DataFrame:
    """Return the table trips: as many departures of each line as its buses can drive.

    Departures are in the fitted proportions of the hours. On Sundays only the lines with the most buses run,
    with the fitted share of all buses.
    """
    runs_on_sundays = round(SUNDAY_LINES * len(fleets))
    sunday_share = SUNDAY_FLEET * sum(fleets) / sum(fleets[:runs_on_sundays])
    frames = []
    vehicle = 0
    for line, (buses, own) in enumerate(zip(fleets, of_line, strict=True)):
        for day in durations:
            wanted = float(buses)
            if day == "sunday":
                if line >= runs_on_sundays:
                    continue
                wanted = max(sunday_share * buses, 1.0)
            trips, blocks = _timetable(round(wanted), [durations[day][p] for p in own], day)
            number = {trip: vehicle + slot for slot, block in enumerate(blocks) for trip in block}
            vehicle += len(blocks)
            frames.append(
                pd.DataFrame(
                    {
                        "pattern": own[[trip.pattern for trip in trips]],
                        "vehicle": [number[i] for i in range(len(trips))],
                        "dep_s": [round(trip.departure) for trip in trips],
                        "arr_s": [round(trip.arrival) for trip in trips],
                        "daytype": day,
                    }
                )
            )
        after_line()
    return pd.concat(frames, ignore_index=True)


def _timetable(buses: int, durations: Sequence[Floats], day: str) -> tuple[list[Trip], list[list[int]]]:
    """Return the trips of a line, as many as `buses` buses can drive, and the trips of each bus."""
    round_trip = sum(float(passed.max()) for passed in durations)
    low, high, base = 0.05, 60.0, 0.8 * buses * 3600.0 / round_trip
    best: tuple[list[Trip], list[list[int]]] = ([], [])
    for _ in range(14):
        trips = _departures(base, durations, day)
        blocks = chain_trips(trips, np.zeros((len(durations),) * 2), 0, BusConfig().recovery_share)
        if not best[0] or abs(len(blocks) - buses) < abs(len(best[1]) - buses):
            best = trips, blocks
        if len(blocks) == buses:
            break
        low, high = (base, high) if len(blocks) < buses else (low, base)
        guess = base * buses / len(blocks)
        base = guess if low * 1.02 < guess < high / 1.02 else math.sqrt(low * high)
    return best


def _departures(base: float, durations: Sequence[Floats], day: str) -> list[Trip]:
    """Return the trips of a line with `base` departures in the peak hour in each direction.

    The directions leave their terminals half a headway apart.
    """
    hourly = np.array(DEPARTURES[day]) * base / max(DEPARTURES[day])
    flow = np.concatenate(([0.0], np.cumsum(hourly)))
    edges = np.arange(5, 25) * 3600.0
    trips = []
    for way, passed in enumerate(durations):
        count = max(int(flow[-1]), 2)
        leaves = np.interp(np.arange(count) + 0.5 * way, flow, edges)
        leaves = smooth_departures(leaves, KNOT_S).times
        arrives = leaves + np.interp(leaves, KNOT_S, passed)
        trips += [Trip(way, float(t), float(a)) for t, a in zip(leaves, arrives, strict=True)]
    return trips
