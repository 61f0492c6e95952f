"""Comparison of simulated with measured statistics."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pandas as pd

from headway.contracts import HeadwayError
from headway_envs.bus.config import BusConfig
from headway_envs.bus.prepare import prepare_replay, source_of
from headway_envs.bus.realism import trip_statistics
from headway_envs.bus.realism.calls import recorded_day, simulated_days
from headway_envs.bus.realism.measured import CITY_LINES, NEARLY_ALL, TOLERANCES, WHOLE_CITY
from headway_envs.bus.scenario.fitted import DOI, SYNTHETIC
from headway_envs.bus.scenario.measures import metres_along
from headway_envs.bus.scenario.network import trips_of_day
from headway_envs.bus.scenario.tables import Tables

HOURS = (4, 26)
"""Hours of the service day of a replay; they contain nearly all trips."""
OWN, RECORDS, CITY = "its own tables", "records of its lines", "records of the whole city"
"""Sources of a measured statistic."""


@dataclass(frozen=True)
class Row:
    """One statistic, simulated and measured."""

    statistic: str
    """Name of the statistic, as in `trip_statistics`."""
    simulated: float
    """Mean over the simulated days that have a value; NaN, which is outside any tolerance, if none has."""
    deviation: float | None
    """Sd over the days; None for a single day."""
    measured: float
    tolerance: float
    """Largest accepted difference between `simulated` and `measured`."""
    source: str
    """Source of the measured value."""
    judged: bool = True
    """False if the value was measured over the whole city but the scenario has too few of its lines."""

    @property
    def off(self) -> float:
        """Simulated minus measured value."""
        return self.simulated - self.measured

    @property
    def holds(self) -> bool:
        """Whether the difference is within the tolerance."""
        return bool(abs(self.off) <= self.tolerance)


def compare_replay(
    tables: Tables,
    config: BusConfig,
    days: int,
    records: Path | None = None,
    after_day: Callable[[], None] = lambda: None,
) -> list[Row]:
    """Return the statistics of `days` replayed days, with MOVE at every decision, and the measured ones.

    They are those of `config.day_type`. Trips and boardings are measured on the scenario's tables; synthetic
    boardings are left out. Headways along the route, dwells and loads (if recorded) are measured on the
    recorded day in `records`. Without `records`, those of the whole city are used if the tables are SUNT's,
    else they are left out; for an extract of few lines they are not judged. The hours of `config` are
    replaced by `HOURS`. `after_day` is called after each simulated day.

    Raises HeadwayError for tables that are synthetic or scheduled, and the errors of `prepare_replay`,
    `simulated_days`, `recorded_day` and `trip_statistics.finished_trip_statistics`.
    """
    if made_up := _made_up(tables):
        raise HeadwayError(
            f"{made_up}, so there are no measurements; give a scenario of recorded trips, "
            "written by headway data sunt or, from calls.csv, by headway data csv"
        )
    config = replace(config, start_hour=HOURS[0], end_hour=HOURS[1])
    prepared = prepare_replay(config, tables)
    measured = {**_city_statistics(tables, config), **_table_statistics(tables, config)}
    if records is not None:
        measured |= _record_statistics(records, tables, config.day_type)
    km = call_km(tables).groupby("pattern").last()
    found = []
    for calls in simulated_days(tables, prepared, days):
        day = trip_statistics.finished_trip_statistics(trip_statistics.finished_trips(calls, km))
        found.append(
            {
                **day,
                **trip_statistics.headway_statistics(calls),
                **trip_statistics.dwell_statistics(calls),
                **trip_statistics.passenger_statistics(calls),
            }
        )
        after_day()
    simulated = pd.DataFrame(found)
    is_city = line_count(tables, config) >= NEARLY_ALL * CITY_LINES[config.day_type]
    rows = []
    for statistic, tolerance in TOLERANCES.items():
        value, source = measured.get(statistic, (np.nan, ""))
        if np.isnan(value):
            continue
        mean = float(simulated[statistic].mean())
        deviation = float(simulated[statistic].std()) if days > 1 else None
        rows.append(
            Row(statistic, mean, deviation, value, tolerance.of(value), source, source != CITY or is_city)
        )
    return rows


def line_count(tables: Tables, config: BusConfig) -> int:
    """Return the number of lines with trips on the configured day type."""
    patterns = trips_of_day(tables.arrays(), config)["pattern"]
    return int(tables.patterns.set_index("pattern")["line"].reindex(patterns).nunique())


def call_km(tables: Tables) -> "pd.Series[float]":
    """Return distances from the pattern's first call along its links, km, sorted by pattern and seq0."""
    return metres_along(tables) / 1000.0


def observed_trips(tables: Tables, config: BusConfig) -> pd.DataFrame:
    """Return the trips of the table in the form that `trip_statistics.finished_trip_statistics` takes.

    Trips that arrive after the end of the service day are left out, because a simulated day stops there, and
    so are trips that arrive when they leave.
    """
    trips = trips_of_day(tables.arrays(), config)
    names = tables.patterns.set_index("pattern").reindex(trips["pattern"])
    stops = tables.pattern_stops.sort_values(["pattern", "seq0"]).groupby("pattern")["stop"]
    frame = pd.DataFrame(
        {
            "line": names["line"].astype(str).to_numpy(),
            "dir": names["dir"].astype(str).to_numpy(),
            "pattern": trips["pattern"],
            "begin": stops.first().reindex(trips["pattern"]).to_numpy(),
            "end": stops.last().reindex(trips["pattern"]).to_numpy(),
            "dep": trips["dep_s"].astype(np.float64),
            "arr": trips["arr_s"].astype(np.float64),
            "km": call_km(tables).groupby("pattern").last().reindex(trips["pattern"]).to_numpy(),
        }
    )
    inside = (frame["arr"] > frame["dep"]) & (frame["arr"] <= config.end_hour * 3600.0)
    return frame[inside].reset_index(drop=True)


def _with_source(source: str, values: Mapping[str, float]) -> dict[str, tuple[float, str]]:
    """Attach a source to each value."""
    return {name: (value, source) for name, value in values.items()}


def _city_statistics(tables: Tables, config: BusConfig) -> dict[str, tuple[float, str]]:
    """Return the statistics of the whole city, if the tables are of that city."""
    if DOI not in source_of(tables.meta):
        return {}
    return _with_source(CITY, WHOLE_CITY[config.day_type])


def _made_up(tables: Tables) -> str:
    """Return why the tables' trips or times are not recorded ones, from the metadata; empty if they are."""
    if source_of(tables.meta).startswith(SYNTHETIC):
        return "the scenario's trips are made up"
    stated = tables.meta.get("made_up")
    if not stated:
        return ""
    names = ", ".join(map(str, stated)) if isinstance(stated, Mapping) else str(stated)
    return f"according to made_up in the scenario's meta.json {names} are made up or scheduled"


def _table_statistics(tables: Tables, config: BusConfig) -> dict[str, tuple[float, str]]:
    """Return the statistics of the tables; boardings only if the metadata do not call them synthetic."""
    values = trip_statistics.finished_trip_statistics(observed_trips(tables, config))
    made_from = tables.meta.get("made_from")
    origin = made_from.get(f"demand {config.day_type}", "") if isinstance(made_from, Mapping) else ""
    if not str(origin).startswith("made up"):
        demand = tables.demand[tables.demand["daytype"] == config.day_type]
        values[trip_statistics.BOARDINGS] = float(demand["board"].sum())
    return _with_source(OWN, values)


def _record_statistics(records: Path, tables: Tables, day_type: str) -> dict[str, tuple[float, str]]:
    """Return the statistics of the recorded day; loads only if it has fares."""
    day = recorded_day(records, tables, day_type)
    values = trip_statistics.headway_statistics(day.calls) | trip_statistics.dwell_statistics(day.calls)
    if day.fares:
        loads = trip_statistics.passenger_statistics(day.calls)
        values |= {name: value for name, value in loads.items() if name != trip_statistics.BOARDINGS}
    return _with_source(f"{RECORDS}, {day.date}", values)
