"""Measures of scenarios that several modules use."""

from dataclasses import replace

import numpy as np
import pytest

from headway_envs.bus.scenario.measures import TIMED_HOURS, distance_m, link_loads
from headway_envs.bus.scenario.synthetic import generate


def test_distances_are_those_of_the_sphere_nearby() -> None:
    radius = 111_320.0 * 180.0 / np.pi
    lat, lon, lat2, lon2 = np.radians([59.9, 10.7, 59.95, 10.8])
    half = np.sin((lat2 - lat) / 2) ** 2 + np.cos(lat) * np.cos(lat2) * np.sin((lon2 - lon) / 2) ** 2
    haversine = 2 * radius * np.arcsin(np.sqrt(half))
    flat = distance_m(*(np.array([degrees]) for degrees in (59.9, 10.7, 59.95, 10.8)))
    assert flat[0] == pytest.approx(haversine, rel=1e-3)


@pytest.mark.parametrize("size", ["line", "district"])
def test_every_size_has_travel_times_of_the_same_hours(size: str) -> None:
    assert sorted(generate(size, 0).link_times["hour"].unique()) == TIMED_HOURS.tolist()


def test_loads_are_boardings_minus_alightings() -> None:
    tables = generate("line", 0)
    stays = tables.alighting.assign(p_alight=(tables.alighting["seq0"] == 44).astype(float))
    loads = link_loads(replace(tables, alighting=stays), "weekday")
    board = tables.demand[tables.demand["daytype"] == "weekday"].groupby(["pattern", "seq0"])["board"].sum()
    own = loads[loads["pattern"] == 0].sort_values("seq0")["load"].to_numpy()
    np.testing.assert_allclose(own[1:], board[0].cumsum().to_numpy()[:-1])
    half = tables.alighting.assign(p_alight=0.5)
    own = link_loads(replace(tables, alighting=half), "weekday")
    own = own[own["pattern"] == 0].sort_values("seq0")["load"].to_numpy()
    assert own[2] == pytest.approx(0.5 * board[0][0] + board[0][1])
