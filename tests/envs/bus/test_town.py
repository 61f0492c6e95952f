"""The synthetic district and city have the sizes and statistics they are fitted to, and connected
networks."""

from collections import Counter

import numpy as np
import pandas as pd
import pytest

from headway_envs.bus.config import BusConfig
from headway_envs.bus.scenario.fitted import BOARDING_TENTHS, HOUR_SHARES, LINK_M_LOGNORMAL
from headway_envs.bus.scenario.network import build
from headway_envs.bus.scenario.synthetic import generate, line_count
from headway_envs.bus.scenario.tables import Tables, check_tables
from headway_envs.bus.scenario.town import FLEETS, LINES, line_fleets


@pytest.fixture(scope="module")
def district() -> Tables:
    return generate("district", 3)


def weekday(frame: pd.DataFrame) -> pd.DataFrame:
    return frame[frame["daytype"] == "weekday"]


@pytest.mark.parametrize("size", ["district", "city"])
def test_fleets_have_the_measured_sum_and_largest_line(size: str) -> None:
    fleets = line_fleets(size)
    assert len(fleets) == LINES[size]
    assert sum(fleets) == FLEETS[size]
    assert min(fleets) >= 1
    assert max(fleets) <= 25
    assert fleets[0] == max(fleets)


def test_the_environment_needs_about_the_fleet_and_keeps_all_lines(district: Tables) -> None:
    network, lines = build(district, BusConfig(scenario="district"))
    assert len(lines) == 40
    assert abs(len(network.slot_line) - 440) < 0.06 * 440
    on_sundays = build(district, BusConfig(scenario="district", day_type="sunday"))
    assert len(on_sundays[1]) == 26
    assert abs(len(on_sundays[0].slot_line) - 440 * 430 / 1359) < 0.15 * 140


def test_links_and_demand_follow_the_fitted_values(district: Tables) -> None:
    check_tables(district)
    metres = np.log(district.pattern_stops.loc[district.pattern_stops["seq0"] > 0, "leg_m"])
    assert metres.mean() == pytest.approx(LINK_M_LOGNORMAL[0], abs=0.02)
    assert metres.std() == pytest.approx(LINK_M_LOGNORMAL[1], abs=0.15)
    boards = weekday(district.demand)
    by_hour = boards.groupby("hour")["board"].sum()
    shares = np.array(HOUR_SHARES["weekday"])
    # In the first hour and the last one buses serve only a part of the stops.
    inner = by_hour.loc[6:22]
    np.testing.assert_allclose(inner / inner.sum(), shares[1:-1] / shares[1:-1].sum(), atol=0.002)
    assert by_hour.loc[5] / by_hour.sum() == pytest.approx(shares[0] / shares.sum(), abs=0.02)
    length = district.patterns.set_index("pattern")["n_stops"].reindex(boards["pattern"]).to_numpy()
    by_tenth = boards["board"].groupby(boards["seq0"].to_numpy() * 10 // length).sum()
    np.testing.assert_allclose(by_tenth / by_tenth.sum(), BOARDING_TENTHS, atol=0.02)


def test_vehicles_of_the_timetable_drive_one_trip_at_a_time_on_one_line(district: Tables) -> None:
    trips = weekday(district.trips).merge(district.patterns[["pattern", "line"]])
    assert len(trips[["vehicle", "line"]].drop_duplicates()) == trips["vehicle"].nunique()
    ordered = trips.sort_values(["vehicle", "dep_s"])
    gap = ordered["dep_s"] - ordered.groupby("vehicle")["arr_s"].shift()
    assert gap.dropna().min() >= 299  # five minutes of recovery, less the rounding
    assert trips["vehicle"].nunique() == sum(line_fleets("district"))


@pytest.mark.slow
def test_lines_share_stops_and_go_one_way_as_often_as_measured() -> None:
    told: list[int] = []
    city = generate("city", 0, lambda: told.append(1))
    check_tables(city)
    assert len(told) == line_count("city") == 382
    assert city.patterns["line"].nunique() == 382
    assert weekday(city.trips)["vehicle"].nunique() == 1359
    ways = Counter(city.patterns.groupby("line").size())
    assert ways == {1: 93, 2: 289}
    calls = city.pattern_stops.merge(city.patterns[["pattern", "line"]])
    assert 3 <= calls.groupby("stop")["line"].nunique().median() <= 8  # measured: 5
    assert 25 <= city.patterns["n_stops"].mean() <= 37  # measured: 34.5
