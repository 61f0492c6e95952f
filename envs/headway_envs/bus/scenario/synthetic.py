"""Synthetic scenarios of a few lines that share no stop, generated from a seed and fitted parameters."""

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from headway.contracts import generator
from headway_envs.bus.config import BusConfig
from headway_envs.bus.scenario.fitted import (
    ALIGHTING_TENTHS,
    ATTRACTIVENESS_SD,
    BOARDING_TENTHS,
    BOARDINGS_PER_TRIP,
    DEPARTURES,
    HOUR_SHARES,
    LINK_M_LOGNORMAL,
    SOURCE,
    STOPS_GAMMA,
    SUNDAY_FLEET,
    SYNTHETIC,
)
from headway_envs.bus.scenario.link_times import fitted_link_times
from headway_envs.bus.scenario.measures import METRES_PER_DEGREE, TIMED_HOURS
from headway_envs.bus.scenario.network import build_from_arrays
from headway_envs.bus.scenario.passengers import alighting_shares, spread_by_tenth
from headway_envs.bus.scenario.tables import NO_LINK, Columns, Tables, stack

FLEETS = {"line": (14,), "corridor": (20, 16, 14, 12, 11, 10, 9, 8, 6, 4)}
"""Number of buses in service at once on each line at the weekday peak, by size of the scenario."""
_STOPS = {"line": (30, 45), "corridor": (15, 60)}
"""Assumption: smallest and largest number of stops of a pattern, as on frequent lines. Patterns outside are
drawn again."""
_HOURS = np.arange(5, 24)
Floats = NDArray[np.float64]


def generate(size: str, seed: int, after_line: Callable[[], None] = lambda: None) -> Tables:
    """Return the tables of a size in SCENARIOS.

    In `line` and `corridor`, line i depends only on (seed, i). `after_line` is called once per line,
    `line_count(size)` times.
    """
    if size not in FLEETS:
        from headway_envs.bus.scenario.town import generate_town

        return generate_town(size, seed, after_line)
    import pandas as pd

    lines = generate_lines(size, seed, after_line)
    frames = {name: pd.DataFrame(columns) for name, columns in lines.items()}
    return Tables(**frames, meta={**META, "size": size, "seed": seed})


def generate_lines(size: str, seed: int, after_line: Callable[[], None] = lambda: None) -> dict[str, Columns]:
    """Return the tables of `line` or `corridor` as arrays, as `generate` does as data frames."""
    lines = []
    for number, buses in enumerate(FLEETS[size]):
        lines.append(_line(size, seed, number, buses))
        after_line()
    return _stack_tables(lines)


def line_count(size: str) -> int:
    """Return the number of lines of a size in SCENARIOS."""
    if size in FLEETS:
        return len(FLEETS[size])
    from headway_envs.bus.scenario.town import LINES

    return LINES[size]


META: dict[str, Any] = {
    "source": f"{SYNTHETIC}, by numbers fitted to {SOURCE}",
    "link_times_include_dwell": True,
}


def _stack_tables(parts: Sequence[dict[str, Columns]]) -> dict[str, Columns]:
    return {name: stack([part[name] for part in parts]) for name in parts[0]}


def _line(size: str, seed: int, number: int, buses: int) -> dict[str, Columns]:
    """Return the tables of one line whose weekday timetable needs `buses` slots.

    The departures are scaled until it does.
    """
    rng = generator(seed, "bus line", number)
    geometry = _geometry(rng, number, _STOPS[size])
    shares = _stop_shares(rng, geometry["pattern_stops"])
    tried: dict[int, dict[str, Columns]] = {}
    peak = max(DEPARTURES["weekday"])
    low, high = 0.5, 60.0
    for _ in range(40):
        base = math.sqrt(low * high)
        tables = {**geometry, **_service(geometry, shares, base / peak)}
        found = len(build_from_arrays(tables, META, BusConfig())[0].slot_line)
        tried[found] = tables
        if found == buses:
            return tables
        low, high = (base, high) if found < buses else (low, base)
    nearest = min(tried, key=lambda count: abs(count - buses))
    return tried[nearest]


def _geometry(rng: np.random.Generator, number: int, limits: tuple[int, int]) -> dict[str, Columns]:
    """Return stops, patterns, links and travel times of a line that runs out along a heading and back.

    The way back is on the other side of the street.
    """
    while True:
        counts = [2 + round(rng.gamma(*STOPS_GAMMA)) for _ in range(2)]
        counts[1] = round(counts[0] * rng.uniform(0.9, 1.1))
        if all(limits[0] <= count <= limits[1] for count in counts):
            break
    heading = rng.uniform(0.0, 2.0 * math.pi)
    ways: list[dict[str, Columns]] = []
    reach = 0.0
    for way, count in enumerate(counts):
        stop0, link0, pattern = 1000 * number + 500 * way, 1000 * number + 500 * way, 2 * number + way
        legs: NDArray[Any] = np.round(np.clip(rng.lognormal(*LINK_M_LOGNORMAL, count - 1), 80, 3000))
        if way == 1:
            legs = np.round(legs * reach / legs.sum())
        reach = float(legs.sum())
        along = np.concatenate(([0.0], np.cumsum(legs)))
        place = along if way == 0 else reach - along
        stops = np.arange(count)
        links = np.append(NO_LINK, link0 + stops[:-1])
        ways.append(
            {
                "stops": _place_stops(stop0 + stops, place, heading, 30.0 * way),
                "patterns": {
                    "pattern": np.array([pattern]),
                    "line": np.array([f"line{number}"]),
                    "dir": np.array(["IV"[way]]),
                    "n_stops": np.array([count]),
                    "length_m": np.array([int(reach)]),
                },
                "pattern_stops": {
                    "pattern": np.full(count, pattern),
                    "seq0": stops,
                    "stop": stop0 + stops,
                    "link": links,
                    "leg_m": np.append(0, legs),
                },
                "links": {
                    "link": links[1:],
                    "from_stop": stop0 + stops[:-1],
                    "to_stop": stop0 + stops[1:],
                    "leg_m": legs,
                },
                "link_times": fitted_link_times(rng, links[1:], legs),
            }
        )
    return _stack_tables(ways)


def _place_stops(stops: NDArray[np.int64], along: Floats, heading: float, aside: float) -> Columns:
    """Return the coordinates of stops along a heading from the centre of Salvador.

    They lie `along` m from the centre and `aside` m to the right of the heading.
    """
    north = along * math.cos(heading) - aside * math.sin(heading)
    east = along * math.sin(heading) + aside * math.cos(heading)
    lat = -12.97 + north / METRES_PER_DEGREE
    lon = -38.50 + east / (METRES_PER_DEGREE * math.cos(math.radians(12.97)))
    return {"stop": stops, "lat": lat, "lon": lon}


def _stop_shares(rng: np.random.Generator, calls: Columns) -> dict[int, tuple[Floats, Floats]]:
    """Return each pattern's shares of the boardings and of the alightings at its stops."""
    shares = {}
    for pattern, count in zip(*np.unique(calls["pattern"], return_counts=True), strict=True):
        parts = []
        for tenths, sd in ((BOARDING_TENTHS, ATTRACTIVENESS_SD), (ALIGHTING_TENTHS, 1.0)):
            weight = rng.lognormal(0.0, sd, count)
            weight[-1 if tenths is BOARDING_TENTHS else 0] = 0.0
            parts.append(spread_by_tenth(tenths, weight))
        shares[int(pattern)] = (parts[0], parts[1])
    return shares


def _service(
    geometry: dict[str, Columns], shares: dict[int, tuple[Floats, Floats]], scale: float
) -> dict[str, Columns]:
    """Return the tables demand, alighting and trips with `scale` times the city's departures per hour."""
    demand, alighting, trips = [], [], []
    for pattern, (boarding, leaving) in shares.items():
        count = len(boarding)
        alighting.append(
            {
                "pattern": np.full(4 * count, pattern),
                "seq0": np.repeat(np.arange(count), 4),
                "period": np.tile(np.arange(4), count),
                "p_alight": np.repeat(alighting_shares(boarding, leaving), 4),
            }
        )
        for day, hourly in DEPARTURES.items():
            # Sunday's own profile is scaled so that its peak has its share of the fleet.
            rate = np.array(hourly) * scale
            if day == "sunday":
                rate *= SUNDAY_FLEET * max(DEPARTURES["weekday"]) / max(hourly)
            flow = np.concatenate(([0.0], np.cumsum(rate)))
            edges = np.append(_HOURS, 24) * 3600.0
            departures = np.interp(np.arange(max(int(flow[-1]), 2)), flow, edges)
            duration = _duration_by_hour(geometry, pattern, day)
            trips.append(
                {
                    "pattern": np.full(len(departures), pattern),
                    "vehicle": np.arange(len(departures)),
                    "dep_s": departures,
                    "arr_s": departures + np.interp(departures / 3600.0, TIMED_HOURS + 0.5, duration),
                    "daytype": np.full(len(departures), day),
                }
            )
            hours = np.array(HOUR_SHARES[day]) / sum(HOUR_SHARES[day])
            total = BOARDINGS_PER_TRIP[day] * len(departures)
            rows = count * len(_HOURS)
            demand.append(
                {
                    "pattern": np.full(rows, pattern),
                    "seq0": np.repeat(np.arange(count), len(_HOURS)),
                    "hour": np.tile(_HOURS, count),
                    "calls": np.tile(np.round(rate), count),
                    "board": total * np.outer(boarding, hours).ravel(),
                    "daytype": np.full(rows, day),
                }
            )
    return {"demand": stack(demand), "alighting": stack(alighting), "trips": stack(trips)}


def _duration_by_hour(geometry: dict[str, Columns], pattern: int, day: str) -> Floats:
    """Return the time that all links of a pattern take in each of TIMED_HOURS, s."""
    calls, times = geometry["pattern_stops"], geometry["link_times"]
    own = np.isin(times["link"], calls["link"][calls["pattern"] == pattern]) & (times["daytype"] == day)
    total, lost = np.zeros(len(TIMED_HOURS)), np.zeros(len(TIMED_HOURS))
    # Kahan's sum, as data frames have it: another would change the last bits of the scenarios of a seed.
    for seconds in times["mean_s"][own].reshape(-1, len(TIMED_HOURS)):
        added = seconds - lost
        lost = (total + added) - total - added
        total = total + added
    return total
