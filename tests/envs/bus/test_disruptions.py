"""Disruptions: what they change, from when on, and nothing else."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from played import begun, repeated

from headway.contracts import HeadwayError
from headway_envs.bus.config import BusConfig, DisruptionConfig, UpkeepConfig
from headway_envs.bus.env import BusBatchedEnv
from headway_envs.bus.kernel.layout import BROKEN, MOVE
from headway_envs.bus.prepare import prepare
from headway_envs.bus.scenario.network import calls_of, pattern_rows
from headway_envs.bus.scenario.synthetic import generate_lines

SOUND = UpkeepConfig(breakdowns_per_hour=0.0, seconds_per_fuel_unit=1e9)
BEFORE_8 = 3 * 60
"""Control intervals before 08:00."""


def env_with(copies: int = 1, traced: bool = False, **disruptions: Any) -> BusBatchedEnv:  # noqa: ANN401 - keys of DisruptionConfig
    config = BusConfig(upkeep=SOUND, disruptions=DisruptionConfig(**disruptions))
    return begun(BusBatchedEnv(prepare(config), copies, traced))


def stops_of_calls() -> NDArray[np.int64]:
    """Return the stop of each call of the line."""
    tables = generate_lines("line", 0)
    return np.asarray(calls_of(tables, pattern_rows(tables, BusConfig()))["stop"], np.int64)


@pytest.mark.parametrize(
    "disruptions", [{"surge": 5.0}, {"slow": 4.0}, {"breakdown_hour": 8, "breakdown_bus": 3}]
)
def test_days_are_ordinary_ones_up_to_the_hour_of_the_disruption(disruptions: dict[str, Any]) -> None:
    ordinary, disrupted = env_with(3), env_with(3, **disruptions)
    for _ in range(BEFORE_8):
        repeated(ordinary, MOVE, 1)
        repeated(disrupted, MOVE, 1)
        np.testing.assert_array_equal(ordinary.observed().observations, disrupted.observed().observations)
    repeated(ordinary, MOVE, 60)
    repeated(disrupted, MOVE, 60)
    assert (ordinary.observed().observations != disrupted.observed().observations).any(axis=(1, 2)).all()


def test_a_surge_multiplies_the_arrivals_of_its_stops_in_its_hour() -> None:
    call = int(np.argmax(env_with().network.arrival_rate[:, 12]))
    stop = int(stops_of_calls()[call])
    drawn: list[list[NDArray[np.int64]]] = []
    for env in (env_with(60), env_with(60, surge=4.0, surge_stops=(stop,))):
        counts = []
        for steps in (BEFORE_8, 60, 60):
            repeated(env, MOVE, steps)
            counts.append(env.world.queues["drawn"].sum(axis=0).astype(np.int64))
        drawn.append(counts)
    ordinary, surged = (np.diff([0 * counts[0], *counts], axis=0) for counts in drawn)
    there = stops_of_calls() == stop
    np.testing.assert_array_equal(ordinary[:, ~there], surged[:, ~there])
    assert ordinary[1, call] > 100
    assert surged[1, call] == pytest.approx(4.0 * ordinary[1, call], rel=0.15)
    assert surged[2, call] == pytest.approx(ordinary[2, call], rel=0.35)


@pytest.mark.parametrize("stops", [(), (0,)])
def test_links_from_the_slow_stops_take_longer_for_departures_in_the_hour(stops: Sequence[int]) -> None:
    """Trips that leave the stop at the same time as on the ordinary day take three times as long."""
    ordinary = env_with(4, traced=True)
    slow = env_with(4, traced=True, slow=3.0, slow_stops=tuple(stops))
    for env in (ordinary, slow):
        repeated(env, MOVE, BEFORE_8 + 90)
    net, there = slow.network, stops_of_calls()
    ratios = {"there": [], "elsewhere": []}  # type: dict[str, list[float]]
    for trip, pattern in enumerate(net.trip_pattern):
        first, last = net.pattern_calls[pattern : pattern + 2]
        middle = (first + last - 1) // 2
        for call in range(first, last - 1):
            entry = slow.trace.first[trip] + call - first
            affected = there[call] in stops if stops else call == middle
            left, other = slow.trace.left[:, entry], ordinary.trace.left[:, entry]
            seconds = slow.trace.arrived[:, entry + 1] - left
            usual = ordinary.trace.arrived[:, entry + 1] - other
            for copy in np.flatnonzero(left == other):
                if np.isfinite(seconds[copy]):
                    within = 8 * 3600.0 <= left[copy] < 9 * 3600.0
                    ratios["there" if affected and within else "elsewhere"].append(
                        seconds[copy] / usual[copy]
                    )
    assert len(ratios["there"]) >= 3
    np.testing.assert_allclose(ratios["there"], 3.0, rtol=1e-6)
    np.testing.assert_allclose(ratios["elsewhere"], 1.0, rtol=1e-6)


def test_a_planned_breakdown_happens_once_at_the_next_stop() -> None:
    env = env_with(2, breakdown_hour=8, breakdown_bus=3)
    broken: list[tuple[float, int]] = []
    for _ in range(env.prepared.config.ticks - 1):
        repeated(env, MOVE, 1)
        if not broken:
            found = np.flatnonzero((env.world.slots["phase"] == BROKEN)[0])
            broken += [(float(env.world.days["now"][0]), int(n)) for n in found]
    assert (env.world.days["breakdowns"] == 1).all()
    [(time, bus)] = broken
    assert bus == 3
    assert 8 * 3600.0 < time < 9 * 3600.0
    repeated(env, MOVE, 2)  # the next day has one too
    assert (env.world.days["breakdown_bus"] == 3).all()


def test_a_late_bus_leaves_the_depot_late_and_no_other_one() -> None:
    ordinary, late = env_with(traced=True), env_with(traced=True, late_s=2400.0, late_bus=2)
    for env in (ordinary, late):
        repeated(env, MOVE, 300)
    net = late.network
    for bus, block in enumerate(net.slot_first[:-1]):
        trip = net.slot_trips[block]
        entry = late.trace.first[trip]
        left, usual, planned = (
            late.trace.left[0, entry],
            ordinary.trace.left[0, entry],
            net.trip_departure[trip],
        )
        if bus == 2:
            assert planned + 2400.0 <= left < planned + 2400.0 + 600.0
        else:
            assert left == usual or (np.isnan(left) and np.isnan(usual))


@pytest.mark.parametrize(
    ("disruptions", "message"),
    [
        (
            {"surge": 2.0, "surge_stops": (9999,)},
            r"no trip calls at stop 9999; `headway data describe line --day-type weekday --stops",
        ),
        ({"late_s": 60.0, "late_bus": 99}, r"disruptions.late_bus: there is no bus 99; the scenario has 14"),
    ],
)
def test_what_the_scenario_lacks_is_one_error_line(disruptions: dict[str, Any], message: str) -> None:
    with pytest.raises(HeadwayError, match=message):
        env_with(**disruptions)


@pytest.mark.parametrize(
    ("disruptions", "message"),
    [
        ({"surge_stops": (1,)}, "surge_stops means nothing with surge=1"),
        ({"late_bus": 1}, "late_bus means nothing with late_s=0"),
        ({"surge_hour": 9}, "surge_hour means nothing with surge=1; leave it out, or .* surge=3"),
        ({"slow_stops": (1,)}, "slow_stops means nothing with slow=1"),
        ({"breakdown_bus": 1}, "breakdown_bus means nothing with breakdown_hour=null"),
        ({"slow": 2.0, "slow_hour": 3}, "slow_hour must lie within the service day, 5 to 23, not 3"),
    ],
)
def test_keys_without_effect_are_refused(disruptions: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        BusConfig(disruptions=DisruptionConfig(**disruptions))
