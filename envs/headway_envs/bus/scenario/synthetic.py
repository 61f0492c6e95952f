"""Synthetic scenarios, generated from a seed by numbers fitted to SUNT.

Source of every number in capitals: SUNT, Salvador Urban Network Transportation (LabIA-UFBA), CC BY 4.0,
doi 10.17632/85fdtx3kr5.1; operations of Monday 2024-08-26 and Sunday 2024-09-15, demand of March 2024 and
ten Sundays.
"""

import math
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from headway.contracts import generator
from headway_envs.bus.config import BusConfig
from headway_envs.bus.scenario.network import build
from headway_envs.bus.scenario.tables import FIRST_LINK, Tables

STOPS_GAMMA = (2.76, 11.9)
"""Stops of a pattern beyond two: gamma shape and scale."""
LINK_M_LOGNORMAL = (5.78, 0.64)
"""Link length, m: mean and sd of the log."""
LINK_S_LOG = (0.29, 0.683, 0.48)
"""Log of a link's mean time in s: intercept, slope on the log of its length, sd of what stays with it."""
WITHIN_HOUR_SD = 0.28
"""Sd of the log of link times within a link and hour."""
SPEED_KMH = {
    "weekday": ((5, 7, 10, 17, 22), (20.5, 14.2, 16.9, 14.5, 23.6)),
    "sunday": ((5, 7, 10, 17, 22), (21.6, 20.0, 18.2, 18.2, 23.6)),
}
"""Mean speed, dwell included, at hours of the day."""
MEAN_SPEED_KMH = 17.2
"""Mean link length over mean link time."""
HOUR_SHARES = {
    "weekday": (
        6.9,
        11.7,
        10.2,
        6.1,
        3.8,
        3.3,
        4.0,
        5.3,
        4.5,
        3.9,
        4.6,
        6.8,
        9.3,
        8.1,
        5.1,
        2.5,
        2.1,
        1.4,
        0.3,
    ),
    "sunday": (3.4, 6.7, 7.2, 6.4, 6.0, 6.0, 6.5, 6.4, 5.8, 5.3, 5.0, 5.3, 6.6, 7.0, 6.4, 4.5, 3.1, 1.8, 0.5),
}
"""Boardings by hour from 05 h on, %."""
DEPARTURES = {
    "weekday": (
        *(1420, 1749, 1562, 1410, 1284, 1199, 1120, 1079, 1101, 1091),
        *(1214, 1399, 1467, 1523, 1340, 1017, 769, 564, 292),
    ),
    "sunday": (457, 620, 659, 629, 661, 652, 632, 662, 676, 653, 660, 667, 644, 636, 616, 515, 443, 348, 203),
}
"""Departures of the whole city by hour from 05 h on."""
SUNDAY_FLEET = 430 / 1359
"""Buses at once on a Sunday over those at the weekday's peak."""
BOARDINGS_PER_TRIP = {"weekday": 47.0, "sunday": 28.0}
"""Median boardings of a trip."""
BOARDING_TENTHS = (0.33, 0.09, 0.10, 0.10, 0.08, 0.08, 0.07, 0.06, 0.05, 0.04)
ALIGHTING_TENTHS = (0.03, 0.04, 0.05, 0.07, 0.07, 0.09, 0.10, 0.09, 0.11, 0.37)
"""Shares of boardings and alightings by tenth of the pattern."""
ATTRACTIVENESS_SD = 1.67
"""Sd of the log of a stop's boardings."""

FLEETS = {"line": (14,), "corridor": (20, 16, 14, 12, 11, 10, 9, 8, 6, 4)}
"""Buses at once on each line of a size, at the weekday's peak."""
_STOPS = {"line": (30, 45), "corridor": (15, 60)}
"""Assumption: patterns are drawn again until their stops lie within these, as of frequent lines."""
_HOURS = np.arange(5, 24)
_TABLES = ("stops", "patterns", "pattern_stops", "links", "link_times", "demand", "alighting", "trips")
Floats = NDArray[np.float64]


def generate(size: str, seed: int) -> Tables:
    """The tables of `line` or `corridor`; line i depends on (seed, i) alone."""
    parts = [_line(size, seed, number, buses) for number, buses in enumerate(FLEETS[size])]
    frames: dict[str, Any] = {
        name: pd.concat([p[name] for p in parts], ignore_index=True) for name in _TABLES
    }
    return Tables(**frames, meta=dict(_META))


_META: dict[str, Any] = {
    "source": "synthetic, by numbers fitted to SUNT (doi 10.17632/85fdtx3kr5.1, CC BY 4.0)",
    "link_times_include_dwell": True,
}


def _line(size: str, seed: int, number: int, buses: int) -> dict[str, pd.DataFrame]:
    """The tables of one line whose timetable needs `buses` slots on a weekday: departures are scaled until
    it does."""
    rng = generator(seed, "bus line", number)
    geometry = _geometry(rng, number, _STOPS[size])
    shares = _stop_shares(rng, geometry["pattern_stops"])
    tried: dict[int, dict[str, Any]] = {}
    peak = max(DEPARTURES["weekday"])
    low, high = 0.5, 60.0
    for _ in range(40):
        base = math.sqrt(low * high)
        frames: dict[str, Any] = {**geometry, **_service(geometry, shares, base / peak)}
        found = len(build(Tables(**frames), BusConfig())[0].slot_line)
        tried[found] = frames
        if found == buses:
            return frames
        low, high = (base, high) if found < buses else (low, base)
    nearest = min(tried, key=lambda count: abs(count - buses))
    return tried[nearest]


def _geometry(rng: np.random.Generator, number: int, limits: tuple[int, int]) -> dict[str, pd.DataFrame]:
    """Stops, patterns, links and travel times: out along a heading and back on the other side."""
    while True:
        counts = [2 + round(rng.gamma(*STOPS_GAMMA)) for _ in range(2)]
        counts[1] = round(counts[0] * rng.uniform(0.9, 1.1))
        if all(limits[0] <= count <= limits[1] for count in counts):
            break
    heading = rng.uniform(0.0, 2.0 * math.pi)
    tables: dict[str, list[pd.DataFrame]] = {name: [] for name in _TABLES[:5]}
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
        tables["stops"].append(_place_stops(stop0 + stops, place, heading, 30.0 * way))
        tables["patterns"].append(
            pd.DataFrame(
                {
                    "pattern": [pattern],
                    "line": [f"line{number}"],
                    "dir": ["IV"[way]],
                    "n_stops": [count],
                    "length_m": [int(reach)],
                }
            )
        )
        links = np.append(FIRST_LINK, link0 + stops[:-1])
        tables["pattern_stops"].append(
            pd.DataFrame(
                {
                    "pattern": pattern,
                    "seq0": stops,
                    "stop": stop0 + stops,
                    "link": links,
                    "leg_m": np.append(0, legs),
                }
            )
        )
        tables["links"].append(
            pd.DataFrame(
                {
                    "link": links[1:],
                    "from_stop": stop0 + stops[:-1],
                    "to_stop": stop0 + stops[1:],
                    "leg_m": legs,
                }
            )
        )
        tables["link_times"].append(_link_times(rng, links[1:], legs))
    return {name: pd.concat(frames, ignore_index=True) for name, frames in tables.items()}


def _place_stops(stops: NDArray[np.int64], along: Floats, heading: float, aside: float) -> pd.DataFrame:
    """Coordinates `along` m from the centre of Salvador on a heading, `aside` m to its right."""
    north = along * math.cos(heading) - aside * math.sin(heading)
    east = along * math.sin(heading) + aside * math.cos(heading)
    lat = -12.97 + north / 111_320.0
    lon = -38.50 + east / (111_320.0 * math.cos(math.radians(12.97)))
    return pd.DataFrame({"stop": stops, "lat": lat, "lon": lon})


def _link_times(rng: np.random.Generator, links: NDArray[np.int64], legs: NDArray[Any]) -> pd.DataFrame:
    intercept, slope, sd = LINK_S_LOG
    base = np.exp(intercept + slope * np.log(legs) + rng.normal(0.0, sd, len(legs)))
    frames = []
    for day, (hours, speeds) in SPEED_KMH.items():
        every = np.arange(4, 27)
        factor = MEAN_SPEED_KMH / np.interp(every, hours, speeds)
        frames.append(
            pd.DataFrame(
                {
                    "link": np.repeat(links, len(every)),
                    "hour": np.tile(every, len(links)),
                    "log_sigma": WITHIN_HOUR_SD,
                    "mean_s": np.maximum(np.outer(base, factor), 8.0).ravel(),
                    "daytype": day,
                }
            )
        )
    return pd.concat(frames, ignore_index=True)


def _stop_shares(rng: np.random.Generator, calls: pd.DataFrame) -> dict[int, tuple[Floats, Floats]]:
    """Of each pattern, the shares of boardings and of alightings at its stops."""
    shares = {}
    for pattern, group in calls.groupby("pattern"):
        count = len(group)
        tenth = np.minimum(np.arange(count) * 10 // count, 9)
        parts = []
        for tenths, sd in ((BOARDING_TENTHS, ATTRACTIVENESS_SD), (ALIGHTING_TENTHS, 1.0)):
            pull = rng.lognormal(0.0, sd, count)
            pull[-1 if tenths is BOARDING_TENTHS else 0] = 0.0
            total = np.bincount(tenth, pull, minlength=10)[tenth]
            share = np.array(tenths)[tenth] * pull / np.maximum(total, 1e-12)
            parts.append(share / share.sum())
        shares[int(str(pattern))] = (parts[0], parts[1])
    return shares


def _hazards(boarding: Floats, alighting: Floats) -> Floats:
    """The share of the load on arrival that alights at each stop, 1 at the last."""
    hazards, load = np.zeros(len(boarding)), 0.0
    for stop in range(len(boarding)):
        leaving = min(alighting[stop], 0.95 * load)
        hazards[stop] = leaving / load if load > 0 else 0.0
        load += boarding[stop] - leaving
    hazards[-1] = 1.0
    return hazards


def _service(
    geometry: dict[str, pd.DataFrame], shares: dict[int, tuple[Floats, Floats]], scale: float
) -> dict[str, pd.DataFrame]:
    """Demand, alighting and trips when departures an hour are `scale` times the city's."""
    demand, alighting, trips = [], [], []
    for pattern, (boarding, leaving) in shares.items():
        count = len(boarding)
        alighting.append(
            pd.DataFrame(
                {
                    "pattern": pattern,
                    "seq0": np.repeat(np.arange(count), 4),
                    "period": np.tile(np.arange(4), count),
                    "p_alight": np.repeat(_hazards(boarding, leaving), 4),
                }
            )
        )
        for day, hourly in DEPARTURES.items():
            # Of Sunday's own profile, so that its peak has its share of the fleet.
            rate = np.array(hourly) * scale
            if day == "sunday":
                rate *= SUNDAY_FLEET * max(DEPARTURES["weekday"]) / max(hourly)
            flow = np.concatenate(([0.0], np.cumsum(rate)))
            edges = np.append(_HOURS, 24) * 3600.0
            departures = np.interp(np.arange(max(int(flow[-1]), 2)), flow, edges)
            times = geometry["link_times"]
            own = geometry["pattern_stops"]["link"][geometry["pattern_stops"]["pattern"] == pattern]
            mine = times[times["link"].isin(own) & (times["daytype"] == day)]
            duration = mine.groupby("hour")["mean_s"].sum()
            arrivals = departures + np.interp(departures / 3600.0, duration.index + 0.5, duration)
            trips.append(
                pd.DataFrame(
                    {
                        "pattern": pattern,
                        "vehicle": np.arange(len(departures)),
                        "dep_s": departures,
                        "arr_s": arrivals,
                        "daytype": day,
                    }
                )
            )
            hours = np.array(HOUR_SHARES[day]) / sum(HOUR_SHARES[day])
            total = BOARDINGS_PER_TRIP[day] * len(departures)
            demand.append(
                pd.DataFrame(
                    {
                        "pattern": pattern,
                        "seq0": np.repeat(np.arange(count), len(_HOURS)),
                        "hour": np.tile(_HOURS, count),
                        "calls": np.tile(np.round(rate), count),
                        "board": total * np.outer(boarding, hours).ravel(),
                        "daytype": day,
                    }
                )
            )
    frames = {"demand": demand, "alighting": alighting, "trips": trips}
    return {name: pd.concat(parts, ignore_index=True) for name, parts in frames.items()}
