"""Metrics of the literature on holding, recomputed from the times and loads of every call."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from headway_envs.bus.config import BusConfig
from headway_envs.bus.env import BusBatchedEnv
from headway_envs.bus.kernel.layout import KNOT_S
from headway_envs.bus.metrics import METRICS
from headway_envs.bus.prepare import prepare
from headway_envs.bus.prepared import Prepared

Day = tuple[BusBatchedEnv, list[dict[str, float]]]


@pytest.fixture(scope="module")
def played(line: Prepared) -> Day:
    """Return an environment whose trace holds two whole days of random holding, and their metrics."""
    env, rng = BusBatchedEnv(line, 2, traced=True), np.random.default_rng(8)
    env.reset(np.arange(2, dtype=np.uint64))
    for _ in range(line.config.ticks):
        outcome, _ = env.step(rng.choice(3, (2, len(line.agents)), p=[0.4, 0.59, 0.01]))
    assert outcome.episode_ended.all()
    return env, [dict(zip(METRICS, row.tolist(), strict=True)) for row in outcome.metrics]


def calls_of_trips(env: BusBatchedEnv) -> list[tuple[int, list[tuple[int, int]]]]:
    """Return each trip with its (call, entry of the trace) in order."""
    net, first = env.network, env.trace.first
    return [
        (trip, [(int(net.pattern_calls[pattern]) + i, int(first[trip]) + i) for i in range(length)])
        for trip, (pattern, length) in enumerate(zip(net.trip_pattern, np.diff(first), strict=True))
    ]


@pytest.mark.parametrize("copy", [0, 1])
def test_departures_give_schedule_deviation_headways_and_bunching(played: Day, copy: int) -> None:
    env, metrics = played
    left, net = env.trace.left[copy], env.network
    deviations: list[float] = []
    departures: dict[int, list[float]] = {}
    for trip, calls in calls_of_trips(env):
        planned = net.trip_departure[trip]
        for call, entry in calls:
            if np.isfinite(left[entry]):
                deviations.append(abs(left[entry] - planned - np.interp(planned, KNOT_S, net.nominal[call])))
                departures.setdefault(call, []).append(left[entry])
    found = metrics[copy]
    assert found["schedule_deviation_s"] == pytest.approx(np.mean(deviations), rel=1e-9)
    gaps = {call: np.diff(sorted(times)) for call, times in departures.items()}
    several = [gap for gap in gaps.values() if len(gap) >= 2]
    assert found["headway_sd_s"] == pytest.approx(np.mean([gap.std() for gap in several]), rel=1e-6)
    relative = np.mean([gap.std() / gap.mean() for gap in several])
    assert found["headway_cv_by_stop"] == pytest.approx(relative, rel=1e-6)

    events = bunched = 0
    for trip, calls in calls_of_trips(env):
        close = False
        target = net.target[net.trip_pattern[trip]]
        for call, entry in calls:
            before = [time for time in departures.get(call, []) if time < left[entry]]
            if before:  # not so where the bus has not left
                now_close = left[entry] - max(before) < 0.25 * np.interp(left[entry], KNOT_S, target)
                events += now_close and not close
                bunched += now_close
                close = now_close
    assert 0 < events < bunched
    assert found["bunching_events"] == events


@pytest.mark.parametrize("copy", [0, 1])
def test_arriving_loads_give_their_dispersion_and_holding_is_per_stop(played: Day, copy: int) -> None:
    env, metrics = played
    trace, stops = env.trace, 0
    loads: dict[int, list[float]] = {}
    for _, calls in calls_of_trips(env):
        for (_, before), (call, entry) in pairwise(calls):
            if np.isfinite(trace.arrived[copy, entry]):
                loads.setdefault(call, []).append(trace.load[copy, before])
            stops += np.isfinite(trace.left[copy, entry])
    dispersion = [np.var(of) / np.mean(of) if np.mean(of) else 0.0 for of in loads.values() if len(of) >= 2]
    found = metrics[copy]
    assert found["occupancy_dispersion"] == pytest.approx(np.mean(dispersion), rel=1e-9)
    last = [calls[-1][1] for _, calls in calls_of_trips(env)]
    finished = int(np.isfinite(trace.arrived[copy, last]).sum())
    held_s = found["held_min_per_trip"] * 60.0 * finished
    assert found["holding_s_per_stop"] == pytest.approx(held_s / stops, rel=1e-9)
    assert found["holding_s_per_stop"] > 10.0


def test_queueing_is_the_time_since_the_first_bus_that_was_full() -> None:
    """With captive passengers it is the integral over time of the number left behind, here sampled every
    10 s."""
    prepared = prepare(BusConfig(captive_share=1.0, capacity=20, tick_s=10.0))
    env = BusBatchedEnv(prepared, 1)
    env.reset(np.zeros(1, np.uint64))
    seconds = 0.0
    for _ in range(prepared.config.ticks):
        waiting = int(env.world.queues["waiting"].sum())
        outcome, _ = env.step(np.ones((1, len(prepared.agents)), np.int64))
        seconds += 10.0 * int(env.world.queues["denied"].sum())
    metrics = dict(zip(METRICS, outcome.metrics[0].tolist(), strict=True))
    per_wait = seconds / (metrics["boardings"] + waiting) / 60.0
    assert metrics["queueing_min"] == pytest.approx(per_wait, rel=0.02)
    assert 0.1 < metrics["queueing_min"] < metrics["mean_wait_min"]
    assert metrics["travel_min"] == metrics["mean_wait_min"] + metrics["in_vehicle_min"]


def test_no_bus_is_full_and_none_held_on_a_calm_day(line: Prepared) -> None:
    env = BusBatchedEnv(replace(line, config=replace(line.config, captive_share=1.0)), 1)
    env.reset(np.zeros(1, np.uint64))
    for _ in range(line.config.ticks):
        outcome, _ = env.step(np.ones((1, len(line.agents)), np.int64))
    metrics = dict(zip(METRICS, outcome.metrics[0].tolist(), strict=True))
    assert metrics["holding_s_per_stop"] == 0.0
    assert (metrics["queueing_min"] > 0.0) == (metrics["denied_boardings"] > 0)
