"""Simulated compared with measured statistics, on the synthetic line and, if present, on SUNT's lines."""

from dataclasses import replace
from pathlib import Path
from typing import cast

import numpy as np
import pytest

from headway.contracts import HeadwayError
from headway_envs.bus.config import BusConfig
from headway_envs.bus.realism import measured, trip_statistics
from headway_envs.bus.realism.comparison import CITY, HOURS, OWN, Row, call_km, compare_replay, observed_trips
from headway_envs.bus.realism.measured import TOLERANCES, WHOLE_CITY, Tolerance
from headway_envs.bus.scenario.fitted import DOI
from headway_envs.bus.scenario.source import scenario_tables
from headway_envs.bus.scenario.tables import Tables, read_tables

SHARED = Path(__file__).resolve().parents[5] / "shared" / "data"


@pytest.fixture(scope="module")
def recorded() -> Tables:
    """Return the synthetic line as a recording of another city."""
    return replace(scenario_tables("line", 0), meta={"source": "a test"})


def test_own_statistics_are_compared_and_departures_agree(recorded: Tables) -> None:
    rows = {row.statistic: row for row in compare_replay(recorded, BusConfig(), 2)}
    assert {row.source for row in rows.values()} == {OWN}
    assert rows[trip_statistics.FIRST_CV].off == pytest.approx(0.0, abs=1e-9)
    assert rows[trip_statistics.FIRST_CV].holds
    assert rows[trip_statistics.TRIP_MEAN].deviation is not None
    assert trip_statistics.cv_name(0) not in rows, "nothing was measured along this route"


def test_observed_trips_have_the_length_of_their_links(recorded: Tables) -> None:
    trips = observed_trips(recorded, BusConfig(start_hour=HOURS[0], end_hour=HOURS[1]))
    km = call_km(recorded)
    for pattern, own in trips.groupby("pattern"):
        assert km.loc[(pattern, 0)] == 0.0
        assert own["km"].to_numpy() == pytest.approx(km.loc[pattern].iloc[-1])


def test_made_up_trips_are_no_measurement() -> None:
    with pytest.raises(HeadwayError, match="the scenario's trips are made up, so there are no measurements"):
        compare_replay(scenario_tables("line", 0), BusConfig(), 1)


def test_a_feed_s_schedule_is_no_measurement(recorded: Tables) -> None:
    feed = {"source": "GTFS feed a.zip", "made_up": {"demand, alighting": "x", "link_times.mean_s": "y"}}
    with pytest.raises(HeadwayError) as error:
        compare_replay(replace(recorded, meta=feed), BusConfig(), 1)
    said = str(error.value)
    assert (
        "made_up in the scenario's meta.json demand, alighting, link_times.mean_s are made up or scheduled"
        in said
    )
    assert "so there are no measurements; give a scenario of recorded trips" in said


def test_boardings_that_were_made_up_are_left_out(recorded: Tables) -> None:
    meta = {"source": "a test", "made_from": {"demand weekday": "made up: 60 boardings per trip"}}
    names = {row.statistic for row in compare_replay(replace(recorded, meta=meta), BusConfig(), 1)}
    assert trip_statistics.BOARDINGS not in names
    assert trip_statistics.TRIP_MEAN in names


def test_a_statistic_missing_on_all_simulated_days_fails(recorded: Tables) -> None:
    demand, meta = recorded.demand.assign(board=0.0), {"source": f"a test of doi:{DOI}"}
    without_passengers = replace(recorded, demand=demand, meta=meta)
    rows = {row.statistic: row for row in compare_replay(without_passengers, BusConfig(), 1)}
    assert np.isnan(rows[trip_statistics.RIDE].simulated), "no passenger rode"
    assert not rows[trip_statistics.RIDE].holds


def test_few_lines_are_not_compared_with_the_whole_city(
    recorded: Tables, monkeypatch: pytest.MonkeyPatch
) -> None:
    few = replace(recorded, meta={"source": f"a test of doi:{DOI}"})
    days: list[int] = []
    rows = compare_replay(few, BusConfig(), 2, after_day=lambda: days.append(1))
    assert len(days) == 2
    assert {row.source: row.judged for row in rows} == {OWN: True, CITY: False}
    monkeypatch.setitem(cast(dict[str, int], measured.CITY_LINES), "weekday", 1)
    assert all(row.judged for row in compare_replay(few, BusConfig(), 1))


def test_trips_that_arrive_after_the_service_day_are_not_measured(recorded: Tables) -> None:
    config = BusConfig(start_hour=HOURS[0], end_hour=HOURS[1])
    trips = recorded.trips.copy()
    latest = trips.index[trips["daytype"] == "weekday"][-1]
    trips.loc[latest, "arr_s"] = HOURS[1] * 3600 + 1
    late = observed_trips(replace(recorded, trips=trips), config)
    assert len(late) == len(observed_trips(recorded, config)) - 1
    assert late["arr"].max() <= HOURS[1] * 3600


def test_a_statistic_holds_up_to_its_tolerance() -> None:
    row = Row("x", 1.05, None, 1.0, 0.05000001, OWN)
    assert row.holds
    assert not replace(row, simulated=0.9).holds
    assert Tolerance(0.1, share=True).of(40.0) == pytest.approx(4.0)
    assert Tolerance(0.1).of(40.0) == 0.1


def test_every_measured_statistic_has_a_tolerance() -> None:
    for values in WHOLE_CITY.values():
        assert set(values) <= set(TOLERANCES)


@pytest.mark.data
@pytest.mark.parametrize("day_type", ["weekday", "sunday"])
def test_salvador_s_busy_lines_are_irregular_as_they_were(day_type: str) -> None:
    folder = SHARED / "sunt" / "lines10"
    if not folder.is_dir():
        pytest.skip(f"SUNT's lines are not there: {folder}")
    config = BusConfig(day_type="sunday" if day_type == "sunday" else "weekday")
    records = SHARED / "sunt_raw"
    rows = compare_replay(read_tables(folder), config, 2, records if records.is_dir() else None)
    found = {row.statistic: row for row in rows}
    assert found[trip_statistics.FIRST_CV].holds
    assert found[trip_statistics.BOARDINGS].holds
    if records.is_dir():
        assert found[trip_statistics.cv_name(0)].holds
        assert CITY not in found[trip_statistics.cv_name(0)].source
    first, last = (found[trip_statistics.cv_name(n)].simulated for n in (0, trip_statistics.FIFTHS - 1))
    assert last > first, "bunching grows along the route"
