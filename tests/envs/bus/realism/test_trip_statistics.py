"""Statistics of days that can be computed by hand."""

import numpy as np
import pandas as pd
import pytest

from headway.contracts import HeadwayError
from headway_envs.bus.realism import trip_statistics


def _calls(times: list[float], calls: int = 5, boarded: list[float] | None = None) -> pd.DataFrame:
    """Return trips that start at `times` (s after 06:00) and reach each of `calls` stops 60 s apart."""
    trips = len(times)
    frame = pd.DataFrame(
        {
            "line": "a",
            "dir": "I",
            "pattern": 0,
            "trip": np.repeat(np.arange(trips), calls),
            "seq0": np.tile(np.arange(calls), trips),
            "calls": calls,
            "stop": np.tile(np.arange(calls), trips),
            "visit": 0,
        }
    )
    frame["time"] = 21600.0 + np.repeat(times, calls) + 60.0 * frame["seq0"]
    frame["arrived"] = frame["time"].where(frame["seq0"] > 0)
    last = frame["seq0"] == calls - 1
    frame["left"] = frame["time"].where(~last)
    frame["boarded"] = np.repeat(boarded if boarded is not None else [2.0] * trips, calls) * ~last
    frame["load"] = 10.0 * np.ones(len(frame))
    frame.loc[last, "load"] = np.nan
    return frame


def test_headways_relative_to_their_window_by_fifth() -> None:
    # Headways of 100, 100, 100, 500 s: mean 200, ratios .5, .5, .5, 2.5; sd with n - 1: 200 s.
    found = trip_statistics.headway_statistics(_calls([0, 100, 200, 300, 800]))
    for fifth in range(trip_statistics.FIFTHS):
        assert found[trip_statistics.cv_name(fifth)] == pytest.approx(1.0)
        assert found[trip_statistics.bunched_name(fifth)] == 0.0
    # 40, 40, 40, 680: mean 200, three of four bunched.
    found = trip_statistics.headway_statistics(_calls([0, 40, 80, 120, 800]))
    assert found[trip_statistics.bunched_name(0)] == 0.75


def test_a_window_of_fewer_than_four_headways_and_the_night_are_left_out() -> None:
    at_night = [14 * 3600.0 + t for t in (0, 40, 80, 120, 800)]
    for times in ([0, 100, 200, 800], at_night):
        found = trip_statistics.headway_statistics(_calls(times))
        assert np.isnan(found[trip_statistics.cv_name(0)])


def test_windows_of_different_headways_are_not_irregular() -> None:
    often, seldom = np.arange(0, 7200, 300), np.arange(7200, 14400, 900)
    found = trip_statistics.headway_statistics(_calls([*often, *seldom], calls=1))
    # But for the one headway between the two, which belongs to the second window.
    assert found[trip_statistics.cv_name(0)] < 0.2


def test_trips_durations_speeds_and_ends() -> None:
    trips = trip_statistics.finished_trips(_calls([0, 100, 200, 300, 800]), pd.Series({0: 2.0}))
    assert len(trips) == 5
    found = trip_statistics.finished_trip_statistics(trips)
    assert found[trip_statistics.TRIP_MEAN] == pytest.approx(4.0)
    assert found[trip_statistics.TRIP_SPREAD] == pytest.approx(0.0)
    assert np.isnan(found[trip_statistics.speed_name(5)])
    assert found[trip_statistics.FIRST_CV] == pytest.approx(1.0)
    assert found[trip_statistics.LAST_CV] == pytest.approx(1.0)
    trips["dep"] -= 1800.0
    trips["arr"] = trips["dep"] + 240.0
    found = trip_statistics.finished_trip_statistics(trips)
    assert found[trip_statistics.speed_name(5)] == pytest.approx(30.0)
    trips["arr"] = trips["dep"] + 240.0 * np.exp([0.1, -0.1, 0.1, -0.1, 0.0])
    found = trip_statistics.finished_trip_statistics(trips)
    assert found[trip_statistics.TRIP_SPREAD] == pytest.approx(10.0)


def test_trips_that_were_not_finished_are_left_out() -> None:
    calls = _calls([0, 100])
    calls = calls[~((calls["trip"] == 1) & (calls["seq0"] == 4))]
    assert list(trip_statistics.finished_trips(calls, pd.Series({0: 2.0}))["trip"]) == [0]


def test_days_without_trips_are_refused() -> None:
    none = trip_statistics.finished_trips(_calls([0]), pd.Series({0: 2.0})).iloc[:0]
    with pytest.raises(HeadwayError, match="no trip was finished within the day"):
        trip_statistics.finished_trip_statistics(none)


def test_loads_ride_length_and_the_response_to_headways() -> None:
    times = [0, 100, 200, 300, 800]
    proportional = trip_statistics.passenger_statistics(_calls(times, boarded=[0.0, 2.0, 2.0, 2.0, 10.0]))
    assert proportional[trip_statistics.RESPONSE] == pytest.approx(1.0)
    constant = trip_statistics.passenger_statistics(_calls(times))
    assert constant[trip_statistics.RESPONSE] == pytest.approx(0.0)
    assert constant[trip_statistics.BOARDINGS] == 40.0
    assert constant[trip_statistics.LOAD_P95] == 10.0
    assert constant[trip_statistics.RIDE] == pytest.approx(10.0 * 20 / 40)
