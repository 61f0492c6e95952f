"""Days with one row per call: simulated calls agree with the environment's totals."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from played import begun, repeated

from headway.contracts import HeadwayError
from headway_envs.bus.config import BusConfig
from headway_envs.bus.entry import ENTRY
from headway_envs.bus.env import BusBatchedEnv
from headway_envs.bus.kernel.layout import MOVE
from headway_envs.bus.prepare import prepare, prepare_replay
from headway_envs.bus.prepared import Prepared
from headway_envs.bus.realism.calls import COLUMNS, recorded_day, simulated_days
from headway_envs.bus.scenario.source import scenario_tables
from headway_envs.bus.scenario.tables import Tables


@pytest.fixture(scope="module")
def tables() -> Tables:
    return scenario_tables("line", 0)


@pytest.fixture(scope="module")
def replay(tables: Tables) -> Prepared:
    return prepare_replay(BusConfig(start_hour=4, end_hour=26), tables)


def test_in_a_replay_every_trip_leaves_at_its_recorded_time(tables: Tables, replay: Prepared) -> None:
    trips = tables.trips[tables.trips["daytype"] == "weekday"]
    observed = np.sort(trips["dep_s"].to_numpy(np.float64))
    for calls in simulated_days(tables, replay, 3):
        left = calls.loc[calls["seq0"] == 0, "left"].to_numpy()
        np.testing.assert_allclose(np.sort(left), observed)


def test_in_a_replay_there_are_no_breakdowns_or_services(replay: Prepared) -> None:
    env = begun(BusBatchedEnv(replay, 2))
    metrics = dict(zip(env.spec.metrics, repeated(env, MOVE, replay.config.ticks).metrics.T, strict=True))
    assert (metrics["breakdowns"] == 0).all()
    assert (metrics["service_visits"] == 0).all()


def test_a_trace_changes_nothing_and_agrees_with_the_totals(line: Prepared) -> None:
    plain, traced = begun(BusBatchedEnv(line, 2)), begun(BusBatchedEnv(line, 2, traced=True))
    rng = np.random.default_rng(3)
    for _ in range(line.config.ticks):
        actions = rng.choice(3, (2, len(line.agents)), p=[0.2, 0.79, 0.01])
        one, _ = plain.step(actions)
        other, _ = traced.step(actions)
        np.testing.assert_array_equal(one.rewards, other.rewards)
    np.testing.assert_array_equal(one.metrics, other.metrics)
    boardings = one.metrics[:, plain.spec.metrics.index("boardings")]
    np.testing.assert_array_equal(traced.trace.boarded.sum(axis=1), boardings)
    assert plain.trace.arrived.size == 0


def test_the_trace_of_a_new_day_begins_empty(line: Prepared) -> None:
    env = begun(BusBatchedEnv(line, 1, traced=True))
    repeated(env, MOVE, line.config.ticks)
    assert np.isfinite(env.trace.arrived).any(), "the day that has ended is still there"
    repeated(env, MOVE, 1)
    assert not np.isfinite(env.trace.arrived).any()
    assert env.trace.boarded.sum() <= env.world.days["boarded"][0]


def test_calls_are_in_order_and_loads_follow_from_boardings(tables: Tables, replay: Prepared) -> None:
    calls = next(simulated_days(tables, replay, 1))
    assert tuple(calls.columns) == COLUMNS
    last = calls["seq0"] == calls["calls"] - 1
    assert calls.loc[~last, "left"].notna().all()
    assert calls.loc[last, "left"].isna().all()
    assert (calls.loc[~last, "left"] >= calls.loc[~last, "time"]).all()
    for _, trip in calls.groupby("trip"):
        assert trip["time"].is_monotonic_increasing
        aboard = trip["load"].to_numpy()[:-1]
        assert (np.diff(aboard) <= trip["boarded"].to_numpy()[1:-1]).all()
        assert aboard[0] == trip["boarded"].iloc[0]


def test_the_same_seed_gives_the_same_day_and_a_rule_another(tables: Tables) -> None:
    prepared = prepare(BusConfig(end_hour=8))
    first, again = (next(simulated_days(tables, prepared, 1)) for _ in range(2))
    pd.testing.assert_frame_equal(first, again)
    held = next(simulated_days(tables, prepared, 1, ENTRY.rules["even_headway"].make(prepared)))
    assert (held["left"] - held["time"]).sum() > (first["left"] - first["time"]).sum()


def test_zero_days_are_refused(tables: Tables, replay: Prepared) -> None:
    with pytest.raises(HeadwayError, match="days must be at least 1, not 0"):
        next(simulated_days(tables, replay, 0))


def _record(folder: Path, line: str) -> None:
    """Write one trip of three calls in SUNT's format."""
    times = ["2024-08-26 07:00:00", "2024-08-26 07:02:00", "2024-08-26 07:05:00"]
    pd.DataFrame(
        {
            "route_short_name": line,
            "register_code": 1,
            "direction_id": "I",
            "pt_sequence": [1, 2, 3],
            "stop_id": [10, 11, 12],
            "vehicle": "20001",
            "trip_id": "a",
            "start_trip": times[0],
            "stop_time": times,
            "n-boardings": [5.0, 2.0, 0.0],
            "n-alighting": [0.0, 1.0, 6.0],
            "lag_loading": [0.0, 5.0, 6.0],
            "loading": [5.0, 6.0, 0.0],
        }
    ).to_parquet(folder / "od-2024-08-26.parquet")


def test_a_recorded_day_has_the_same_columns(tables: Tables, tmp_path: Path) -> None:
    _record(tmp_path, str(tables.patterns["line"].iloc[0]))
    stated = replace(tables, meta={"dates": {"weekday": "2024-08-26"}})
    day = recorded_day(tmp_path, stated, "weekday")
    assert set(day.calls.columns) == set(COLUMNS)
    assert day.fares
    np.testing.assert_array_equal(day.calls["time"], [25200.0, 25320.0, 25500.0])
    np.testing.assert_array_equal(day.calls["load"], [5.0, 6.0, np.nan])
    np.testing.assert_array_equal(day.calls["arrived"], [np.nan, 25320.0, 25500.0])


@pytest.mark.parametrize(
    ("line", "meta", "said"),
    [
        ("own", {}, "meta.json names no date of the timetable: add dates"),
        ("own", {"dates": ["2024-08-26"]}, r"meta.json: dates must be \{DAY_TYPE: YYYY-MM-DD\}, not"),
        ("own", {"dates": {"weekday": "soon"}}, "a weekday must be text, YYYY-MM-DD, not 'soon'"),
        ("own", {"dates": {"weekday": 20240826}}, "must be text, YYYY-MM-DD, not 20240826"),
        ("own", {"ops_weekday": ["2024-08-26"]}, "must be text, YYYY-MM-DD, not"),
        ("own", {"dates": {"weekday": "2024-08-27"}}, "lacks od-2024-08-27.parquet"),
        ("another", {"ops_weekday": "2024-08-26"}, "has no trip of the scenario's lines"),
    ],
)
def test_records_of_another_scenario_are_refused(
    tables: Tables, tmp_path: Path, line: str, meta: dict[str, object], said: str
) -> None:
    _record(tmp_path, str(tables.patterns["line"].iloc[0]) if line == "own" else line)
    with pytest.raises(HeadwayError, match=said):
        recorded_day(tmp_path, replace(tables, meta=meta), "weekday")
