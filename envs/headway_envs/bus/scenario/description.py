"""Statistics that describe a scenario, per day type and per line."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from headway_envs.bus.config import BusConfig
from headway_envs.bus.scenario.network import build
from headway_envs.bus.scenario.tables import DAY_TYPES, Tables

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class DayStatistics:
    """Statistics of one day type; `LABELS` names them, with their units as `readable` shows them."""

    day_type: str
    lines: int
    trips: int
    first_h: float
    last_h: float
    vehicles: int
    peak_buses: int
    peak_h: float
    agents: int
    trip_min: float
    headway_morning: float | None
    headway_midday: float | None
    headway_evening: float | None
    boardings: float
    boardings_per_trip: float
    busiest_hour: int
    """Hour with the most boardings."""

    LABELS: ClassVar[Mapping[str, str]] = {
        "lines": "lines that run",
        "trips": "trips",
        "first_h": "first departure",
        "last_h": "last arrival",
        "vehicles": "vehicles in the timetable",
        "peak_buses": "most buses at once",
        "peak_h": "time of most buses",
        "agents": "agents (slots), 05:00-24:00",
        "trip_min": "mean trip, min",
        "headway_morning": "headway 06:00-08:00, min",
        "headway_midday": "headway 10:00-14:00, min",
        "headway_evening": "headway 17:00-19:00, min",
        "boardings": "boardings",
        "boardings_per_trip": "boardings per trip",
        "busiest_hour": "busiest hour",
    }


@dataclass(frozen=True)
class LineStatistics:
    """Statistics of one line on one day type; `LABELS` names them, with their units as `readable` shows
    them."""

    line: str
    patterns: int
    stops: int
    km: float
    trips: int
    agents: int
    headway_morning: float | None
    trip_min: float
    boardings: float

    LABELS: ClassVar[Mapping[str, str]] = {
        "line": "line",
        "patterns": "patterns",
        "stops": "stops",
        "km": "km",
        "trips": "trips",
        "agents": "agents",
        "headway_morning": "headway 06:00-08:00, min",
        "trip_min": "mean trip, min",
        "boardings": "boardings",
    }


def readable(statistics: DayStatistics | LineStatistics, field: str) -> str | int | float:
    """Return a value for people: times of day as 07:30, others with one decimal."""
    value: str | int | float | None = getattr(statistics, field)
    if value is None:
        return "fewer than 2 departures"  # only headways can be unknown
    if field == "busiest_hour":
        return f"{clock(float(value))}-{clock(float(value) + 1.0)}"
    if field.endswith("_h"):
        return clock(float(value))
    return round(value, 1) if isinstance(value, float) else value


def clock(hours: float) -> str:
    """Format hours after midnight of the service day as `25:05`."""
    minutes = round(60.0 * hours)
    return f"{minutes // 60:02d}:{minutes % 60:02d}"


def by_day_type(tables: Tables, after_day: Callable[[], None]) -> list[DayStatistics]:
    """Return the statistics of each day type that has trips; takes seconds per day type for a city.

    `after_day` is called after each of `DAY_TYPES`.
    """
    found = []
    for day in DAY_TYPES:
        trips = tables.trips[tables.trips["daytype"] == day]
        if trips.empty:
            after_day()
            continue
        demand = tables.demand[tables.demand["daytype"] == day]
        by_hour = demand.groupby("hour")["board"].sum()
        times, buses = buses_at_once(trips)
        peak = int(np.argmax(buses))
        line_of = tables.patterns.set_index("pattern")["line"]
        found.append(
            DayStatistics(
                day_type=day,
                lines=int(line_of.reindex(trips["pattern"]).nunique()),
                trips=len(trips),
                first_h=float(trips["dep_s"].min() / 3600.0),
                last_h=float(trips["arr_s"].max() / 3600.0),
                vehicles=int(trips["vehicle"].nunique()),
                peak_buses=int(buses[peak]),
                peak_h=float(times[peak] / 3600.0),
                agents=int(_agents(tables, day).sum()),
                trip_min=float((trips["arr_s"] - trips["dep_s"]).mean() / 60.0),
                headway_morning=_headway(trips, 6, 8),
                headway_midday=_headway(trips, 10, 14),
                headway_evening=_headway(trips, 17, 19),
                boardings=float(by_hour.sum()),
                boardings_per_trip=float(by_hour.sum() / len(trips)),
                busiest_hour=int(str(by_hour.idxmax())) if len(by_hour) else 0,
            )
        )
        after_day()
    return found


def by_line(tables: Tables, day: str) -> list[LineStatistics]:
    """Return the statistics of the lines with trips on day type `day`, most trips first."""
    trips = tables.trips[tables.trips["daytype"] == day].merge(
        tables.patterns[["pattern", "line"]], on="pattern"
    )
    legs = tables.pattern_stops[tables.pattern_stops["seq0"] > 0].merge(
        tables.links[["link", "leg_m"]], on="link", suffixes=("_here", "")
    )
    metres = legs.groupby("pattern")["leg_m"].sum()
    boards = tables.demand[tables.demand["daytype"] == day].groupby("pattern")["board"].sum()
    agents = _agents(tables, day)
    found = []
    for line, own in trips.groupby("line"):
        patterns = own["pattern"].unique()
        calls = tables.pattern_stops["pattern"].isin(patterns)
        found.append(
            LineStatistics(
                line=str(line),
                patterns=len(patterns),
                stops=int(tables.pattern_stops.loc[calls, "stop"].nunique()),
                km=float(metres.reindex(patterns).sum() / 1000.0),
                trips=len(own),
                agents=int(agents.get(str(line), 0)),
                headway_morning=_headway(own, 6, 8),
                trip_min=float((own["arr_s"] - own["dep_s"]).mean() / 60.0),
                boardings=float(boards.reindex(patterns).sum()),
            )
        )
    return sorted(found, key=lambda statistics: (-statistics.trips, statistics.line))


def by_stop(tables: Tables, day: str) -> list[tuple[str, str | None, str, float]]:
    """Return number, name, lines and boardings of the stops with calls on day type `day`, most boardings
    first.

    The number is that of the table stops, as in `env.args.disruptions`; the name is None if it has none.
    """
    running = tables.trips.loc[tables.trips["daytype"] == day, "pattern"].unique()
    calls = tables.pattern_stops[tables.pattern_stops["pattern"].isin(running)]
    lines = calls.merge(tables.patterns[["pattern", "line"]], on="pattern").groupby("stop")["line"].unique()
    demand = tables.demand[tables.demand["daytype"] == day]
    boards = calls.merge(demand, on=["pattern", "seq0"]).groupby("stop")["board"].sum()
    stops = tables.stops.reindex(columns=["stop", "name"]).astype({"name": object})
    names = stops.fillna("").set_index("stop")["name"]
    found = [
        (
            str(stop),
            names.get(stop) or None,
            ", ".join(sorted(own)),
            round(float(boards.get(stop, 0.0)), 1),
        )
        for stop, own in lines.items()
    ]
    return sorted(found, key=lambda row: -row[-1])


def meta_rows(meta: Mapping[str, Any]) -> list[tuple[str, str | int | float]]:
    """Return the metadata as rows (name, value). A mapping, such as `counted`, becomes one row per entry."""
    rows: list[tuple[str, str | int | float]] = []
    for name, value in meta.items():
        if isinstance(value, Mapping):
            rows += [(f"{name}: {part}", _plain(count)) for part, count in value.items()]
        else:
            rows.append((name, _plain(value)))
    return rows


def buses_at_once(trips: pd.DataFrame) -> tuple[Floats, NDArray[np.int64]]:
    """Return the times at which trips begin or end, s, and the number of buses under way after each."""
    times = np.concatenate((trips["dep_s"].to_numpy(np.float64), trips["arr_s"].to_numpy(np.float64)))
    change = np.repeat([1, -1], len(trips))
    # At equal times arrivals come first, so that a bus that turns at once is not counted twice.
    order = np.lexsort((change, times))
    return times[order], np.cumsum(change[order])


def _agents(tables: Tables, day: str) -> "pd.Series[int]":
    """Return the number of slots by line; empty if no trip lies within the default service day."""
    config = BusConfig(day_type="sunday" if day == "sunday" else "weekday")
    trips = tables.trips[tables.trips["daytype"] == day]
    if not trips["dep_s"].between(config.start_hour * 3600.0, config.end_hour * 3600.0, "left").any():
        return pd.Series(dtype=np.int64)
    network, lines = build(tables, config)
    return pd.Series(np.bincount(network.slot_line, minlength=len(lines)), index=list(lines))


def _headway(trips: pd.DataFrame, begin: int, end: int) -> float | None:
    """Return the mean time between departures from `begin` to `end` h, minutes: the median over patterns.

    None if no pattern has two departures.
    """
    inside = trips[trips["dep_s"].between(begin * 3600.0, end * 3600.0, "left")]
    departures = inside.groupby("pattern")["dep_s"].agg(["min", "max", "size"])
    several = departures[departures["size"] > 1]
    gaps_min = (several["max"] - several["min"]) / 60.0 / (several["size"] - 1)
    return float(gaps_min.median()) if len(gaps_min) else None


def _plain(value: object) -> str | int | float:
    if isinstance(value, str | int | float) and not isinstance(value, bool):
        return value
    if isinstance(value, list | tuple):
        return ", ".join(str(part) for part in value)
    return str(value)
