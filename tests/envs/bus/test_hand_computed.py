"""A small scenario computed by hand, and random draws compared with their distributions."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from played import begun, repeated

from headway_envs.bus.config import BusConfig, NoiseConfig
from headway_envs.bus.env import BusBatchedEnv
from headway_envs.bus.kernel import draws
from headway_envs.bus.kernel.layout import MOVE, WAIT
from headway_envs.bus.prepare import prepare
from headway_envs.bus.prepared import Prepared
from headway_envs.bus.scenario.network import build
from headway_envs.bus.scenario.tables import NO_LINK, Tables, check_tables

CALM = NoiseConfig(
    trip_sd=0.0,
    day_sd=0.0,
    evening_peak=0.0,
    network_sd=0.0,
    incident_probability=0.0,
    link_floor_sd=0.0,
    demand_day_sd=0.0,
    demand_stop_hour_sd=0.0,
    dispatch_s=0.0,
)


def tiny(board: float = 1e-9, changed: BusConfig | None = None) -> Prepared:
    """Return a scenario of three stops 100 s apart, trips at 05:10 and 05:40, no noise and few passengers;
    with other arguments as in `changed`."""
    frames = {
        "stops": {"stop": [0, 1, 2], "lat": [0.0, 0.0, 0.0], "lon": [0.0, 0.01, 0.02]},
        "patterns": {"pattern": [0], "line": ["a"], "dir": ["I"], "n_stops": [3]},
        "pattern_stops": {"pattern": [0] * 3, "seq0": [0, 1, 2], "stop": [0, 1, 2], "link": [NO_LINK, 0, 1]},
        "links": {"link": [0, 1], "from_stop": [0, 1], "to_stop": [1, 2], "leg_m": [1113, 1113]},
        "link_times": {
            "link": [0, 1],
            "hour": 5,
            "log_sigma": 1e-9,
            "mean_s": 100.0,
            "daytype": "weekday",
        },
        "demand": {"pattern": [0], "seq0": 0, "hour": 5, "calls": 2, "board": board, "daytype": "weekday"},
        "alighting": {
            "pattern": [0] * 12,
            "seq0": [0, 1, 2] * 4,
            "period": np.repeat(range(4), 3),
            "p_alight": [0.0, 0.0, 1.0] * 4,
        },
        "trips": {
            "pattern": [0, 0],
            "vehicle": [0, 1],
            "dep_s": [18600, 20400],
            "arr_s": [18800, 20600],
            "daytype": "weekday",
        },
    }
    tables = Tables(
        **{name: pd.DataFrame(frame) for name, frame in frames.items()},
        meta={"link_times_include_dwell": False},
    )
    check_tables(tables)
    config = replace(changed or BusConfig(), end_hour=6, noise=CALM, captive_share=1.0)
    network, lines = build(tables, config)
    return Prepared(config, network, lines, "tiny")


def test_events_fall_at_the_times_computed_by_hand() -> None:
    """The dispatch window opens at 18600 - 180 = 18420 s; with MOVE, stop 1 is at 18520 s, the end at 18620
    s."""
    env = begun(BusBatchedEnv(tiny(), 1))
    seen = []
    for tick in range(20):
        # The tick 8 x 60 s after 05:00 holds the stop 1 decision at 18520 s, one minute longer.
        outcome = repeated(env, WAIT if tick == 8 else MOVE, 1)
        seen.append((env.world.event_time[0, 0], bool(outcome.acting[0, 0])))
    assert seen[6] == (18420.0, False)
    assert seen[7] == (18520.0, True)
    assert seen[8] == (18580.0, True)
    assert seen[9][1]
    assert seen[9][0] == 18680.0
    assert env.world.trip_time[0, 0] == pytest.approx(18680.0 - 18420.0)


@pytest.mark.parametrize(("every", "end_s", "decisions"), [(1, 18920.0, [10, 12]), (2, 18830.0, [10])])
def test_a_bus_is_held_once_per_stop_for_the_time_chosen(
    every: int, end_s: float, decisions: list[int]
) -> None:
    """The first trip decides at 18600 s, the start of interval 10, and is held 30 s; at stop 1, if that has
    control, at 18730 s, in interval 12, and is held 90 s. Levels are 30 s apart; those of other intervals are
    not used."""
    env = begun(BusBatchedEnv(tiny(changed=BusConfig(control="holding", control_every=every)), 1))
    acted = []
    for tick in range(20):
        outcome = repeated(env, {10: 1, 12: 3}.get(tick, 6), 1)
        acted += [tick] if outcome.acting[0, 0] else []
    assert acted == decisions
    assert env.world.trip_time[0, 0] == pytest.approx(end_s - 18630.0)
    assert env.world.days["held"][0] == (90.0 if every == 1 else 0.0)


def test_holding_times_in_seconds_are_clipped_and_kept_to_the_millisecond() -> None:
    env = begun(BusBatchedEnv(tiny(changed=BusConfig(control="holding", hold_levels=0)), 1))
    for tick in range(20):
        env.step(np.full((1, 1, 1), {10: -5.0, 11: 12.3456}.get(tick, 1e9), np.float32))
    # Left at 18600 s, at stop 1 at 18700 s, in interval 11.
    assert env.world.trip_time[0, 0] == pytest.approx(100.0 + 12.346 + 100.0)
    with pytest.raises(ValueError, match="actions must have shape"):
        env.step(np.zeros((1, 3, 1), np.float32))


def test_a_queue_boards_first_come_first_served_with_its_exact_waits() -> None:
    """Passengers at the first stop wait from their arrival to the decision at which they board."""
    env = begun(BusBatchedEnv(tiny(board=120.0), 1))
    repeated(env, MOVE, 7)
    waiting = int(env.world.queues["waiting"][0, 0])
    arrived = env.world.arrived_at[0, :waiting].copy()
    assert waiting > 3
    repeated(env, MOVE, 1)  # the window opens at 18420, exactly the start of this tick
    day = env.world.days[0]
    expected = np.sum(18420.0 - arrived)
    later = day["boarded"] - waiting
    assert later >= 0
    assert expected - 1e-6 <= day["wait"] <= expected + 60.0 * later + 1e-6


def test_as_many_passengers_come_as_the_table_states() -> None:
    """The table states 120 per hour at 05:30 and none at 04:30, so 75, 105 and 105 per hour come in the
    quarter hours whose middles are 05:07:30, 05:22:30 and 05:37:30. The last bus leaves before the middle of
    the fourth."""
    days = 400
    env = begun(BusBatchedEnv(tiny(board=120.0), days))
    repeated(env, MOVE, env.prepared.config.ticks - 1)
    expected = (75 + 105 + 105) / 4
    deviation = np.sqrt(expected / days)
    assert env.world.days["arrived"].mean() == pytest.approx(expected, abs=4 * deviation)


def test_the_unit_draws_have_mean_one_and_their_deviation() -> None:
    key = np.uint64(12345)
    z = np.array([draws.normal(key, 1, i, 0) for i in range(20000)])
    assert abs(z.mean()) < 0.03
    assert abs(z.std() - 1) < 0.03
    gamma = np.array([draws.unit_gamma(value, 0.13) for value in z])
    assert abs(gamma.mean() - 1) < 0.005
    assert abs(gamma.std() - 0.13) < 0.005
    lognormal = np.array([draws.unit_lognormal(value, 0.28) for value in z])
    assert abs(lognormal.mean() - 1) < 0.01
    unit = np.array([draws.uniform(key, 2, i, 7) for i in range(20000)])
    counts = np.array([draws.binomial(u, 40, 0.7) for u in unit])
    assert abs(counts.mean() - 28) < 0.1
    assert abs(counts.var() - 8.4) < 0.4
    assert abs(np.mean([draws.exponential(key, 3, i, 0) for i in range(20000)]) - 1) < 0.03


def test_of_passengers_who_are_not_captive_more_arrive_but_as_many_board() -> None:
    """The demand is stated as boardings at the target headway. When buses bunch, some more are lost."""
    days = {}
    for share in (1.0, 0.5):
        env = begun(BusBatchedEnv(prepare(BusConfig(captive_share=share)), 1))
        repeated(env, MOVE, env.prepared.config.ticks - 1)
        days[share] = env.world.days[0].copy()
    assert days[0.5]["boarded"] == pytest.approx(days[1.0]["boarded"], rel=0.15)
    assert days[0.5]["arrived"] > 2 * days[1.0]["arrived"]
