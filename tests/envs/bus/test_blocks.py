"""Vehicles chained at terminals."""

import numpy as np
import pandas as pd

from headway_envs.bus.scenario.blocks import TERMINAL_M, chain_at_terminals, terminals

METRE = 1.0 / 111_320.0


def test_no_two_stops_of_a_terminal_are_far_from_each_other() -> None:
    """Forty stops along five kilometres form many terminals, although each is close to the next."""
    north = np.append(130.0 * np.arange(40), 9000.0)
    stops = pd.DataFrame({"lat": north * METRE, "lon": 0.0})
    found = terminals(stops, np.arange(41))
    of_stop = np.array([found[stop] for stop in range(41)])
    for terminal in np.unique(of_stop):
        assert np.ptp(north[of_stop == terminal]) <= TERMINAL_M * 1.0001
    assert 14 <= len(np.unique(of_stop)) <= 21  # of two or three stops each, and the last one alone
    assert np.sum(of_stop == of_stop[40]) == 1


def test_stops_across_a_square_are_one_terminal_where_buses_turn() -> None:
    stops = pd.DataFrame({"lat": np.array([0.0, 200.0, 0.0, 5000.0]) * METRE, "lon": [0, 0, 200 * METRE, 0]})
    found = terminals(stops, np.array([0, 1, 2, 3, 3]))
    assert found[0] == found[1] == found[2] != found[3]
    trips = pd.DataFrame(
        {
            "dep_s": [0.0, 1000.0, 5000.0],
            "arr_s": [900.0, 2000.0, 6000.0],
            "begin": [found[3], found[0], found[2]],
            "end": [found[1], found[3], found[3]],
        }
    )
    # The first rests for five minutes when the second leaves; the third takes it on.
    assert chain_at_terminals(trips).tolist() == [0, 1, 0]
