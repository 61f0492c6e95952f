"""Vehicles enter, cross, crash and leave as in SUMO, and are counted once."""

from collections import defaultdict
from collections.abc import Callable
from itertools import accumulate
from typing import Any

import numpy as np
import pytest

from headway.contracts import HeadwayError
from headway_envs.junctions.config import JunctionsConfig
from headway_envs.junctions.env import JunctionsBatchedEnv
from headway_envs.junctions.prepared import prepare
from headway_envs.sumo_simulation import libsumo

Open = Callable[..., Any]
SEED = np.array([3], np.uint64)
BRAKE, KEEP, GO = (np.full((1, 96), action) for action in range(3))
WILD: dict[str, Any] = {"av_speed_mode": 0, "hdv_speed_mode": 1}
"""Speed modes without checks, for many crashes."""


def test_every_vehicle_is_on_the_road_or_has_left_or_collided(junctions: Open) -> None:
    env, sumo, arrived, collided, entered = junctions(**WILD), libsumo(), 0, 0, 0
    env.reset(SEED)
    present, events = set(env.traffic.vehicles), {"truncated": 0, "terminated": 0}
    before = env.observed().observations[0].copy()
    for _ in range(600):
        outcome, observed = env.step(GO)
        assert set(env.traffic.vehicles) == set(sumo.vehicle.getIDList())
        crashed = {
            name for crash in sumo.simulation.getCollisions() for name in (crash.collider, crash.victim)
        }
        left = set(sumo.simulation.getArrivedIDList()) - crashed
        entered += len(sumo.simulation.getDepartedIDList())
        arrived, collided = arrived + len(left), collided + len(crashed)
        assert (outcome.rewards == np.float32(len(left) - 5 * len(crashed))).all()
        for name in events:
            ended = np.flatnonzero(getattr(outcome, name)[0])
            events[name] += len(ended)
            assert not observed.alive[0, ended].any()
            assert outcome.acting[0, ended].all()
            np.testing.assert_array_equal(outcome.final_observations[0, ended], before[ended])
        before = observed.observations[0].copy()
        holders = [vehicle.slot for vehicle in env.traffic.vehicles.values() if vehicle.slot >= 0]
        assert sorted(holders) == np.flatnonzero(observed.alive[0]).tolist()
    assert len(present) + entered - arrived - collided == len(env.traffic.vehicles)
    assert min(collided, *events.values()) >= 4


@pytest.mark.parametrize("share", [0.333, 0.5, 1.0, 0.05])
def test_every_nth_vehicle_of_a_road_is_automated(share: float, junctions: Open) -> None:
    env, sumo = junctions(automated_share=share, lead_in_s=0, slots=300), libsumo()
    env.reset(SEED)
    kinds: dict[str, list[bool]] = defaultdict(list)
    for _ in range(500):
        env.step(np.full((1, 300), 2))
        for name in sumo.simulation.getDepartedIDList():
            kinds[sumo.vehicle.getRoadID(name)].append(env.traffic.vehicles[name].slot >= 0)
    assert len(kinds) == 4
    for found in kinds.values():
        assert len(found) > 20
        assert found[0]
        for number, automated in enumerate(accumulate(found), start=1):
            assert -1e-9 < automated - share * number < 1


def test_actions_change_the_speed_within_safe_gaps(junctions: Open) -> None:
    env = junctions()
    env.reset(SEED)
    changes = defaultdict(list)
    for action, chosen in enumerate((BRAKE, KEEP, GO)):
        env.step(KEEP)
        before = {name: vehicle.speed for name, vehicle in env.traffic.vehicles.items() if vehicle.slot >= 0}
        env.step(chosen)
        for name, vehicle in env.traffic.vehicles.items():
            if name in before:
                changes[action].append((before[name], vehicle.speed))
    for (lost, share), action in zip(((-1.75, 1.0), (0.0, 0.5), (0.75, 0.3)), range(3), strict=True):
        wanted = [max(speed + lost, 0) for speed, _ in changes[action]]
        after = [speed for _, speed in changes[action]]
        assert (np.array(after) <= np.array(wanted) + 1e-6).all()
        assert np.isclose(after, wanted).mean() >= share


def test_the_horizon_truncates_all_and_the_next_episode_is_another(junctions: Open) -> None:
    env, seen = junctions(horizon=60, warm_up_s=10), []
    for _ in range(2):
        env.reset(SEED)
        for _ in range(2):
            for _ in range(60):
                outcome, observed = env.step(KEEP)
            assert outcome.episode_ended[0]
            assert outcome.truncated.any()
            assert (outcome.truncated ^ outcome.terminated).all()
            assert observed.alive.any()  # SUMO has driven for lead_in_s
            seen.append(outcome.final_states.copy())
    assert (seen[0] != seen[1]).any()
    assert (seen[0] == seen[2]).all()
    assert (seen[1] == seen[3]).all()


def test_metrics_leave_out_the_warm_up(junctions: Open) -> None:
    env, sumo = junctions(horizon=300, warm_up_s=50, **WILD), libsumo()
    env.reset(SEED)
    arrived, speeds, crashed, paid = 0, [], 0, 0.0
    for step in range(300):
        outcome, _ = env.step(GO)
        paid += float(outcome.rewards[0, 0])
        if step < 100 or step == 299:
            continue
        gone = {name for crash in sumo.simulation.getCollisions() for name in (crash.collider, crash.victim)}
        crashed += len(gone)
        arrived += len(set(sumo.simulation.getArrivedIDList()) - gone)
        speeds += [sumo.vehicle.getSpeed(name) for name in sumo.vehicle.getIDList()]
    found = dict(zip(env.spec.metrics, outcome.metrics[0].tolist(), strict=True))
    last = paid - found["team_return"]
    assert last == pytest.approx(0)
    assert found["outflow_vph"] / 36 == pytest.approx(arrived, abs=3)  # the last step has been discarded
    assert found["collided_vehicles"] == pytest.approx(crashed, abs=4)
    assert found["speed"] == pytest.approx(np.mean(speeds), rel=0.02)
    assert found["inflow_vph"] > 2000
    assert 5 < found["fuel_l_100km"] < 60
    assert found["co2_g_km"] / found["fuel_l_100km"] == pytest.approx(
        23, rel=0.1
    )  # 2.3 kg per litre of petrol


def test_avs_beyond_the_slots_are_driven_by_sumo(junctions: Open) -> None:
    env = junctions(slots=2, horizon=100, warm_up_s=0, automated_share=1.0)
    env.reset(SEED)
    for _ in range(100):
        outcome, _ = env.step(np.ones((1, 2), np.int64))
    found = dict(zip(env.spec.metrics, outcome.metrics[0].tolist(), strict=True))
    assert found["avs"] <= 2
    assert found["avs_without_slot"] > 10


def test_a_process_holds_one_copy(junctions: Open) -> None:
    with pytest.raises(HeadwayError, match="can hold 1 copy of the junctions, not 2"):
        JunctionsBatchedEnv(prepare(JunctionsConfig()), 2)
    env = junctions()
    env.reset(SEED)
    with pytest.raises(ValueError, match=r"actions must have shape \(1, 96\), not \(1, 95\)"):
        env.step(np.zeros((1, 95), np.int64))
