"""Rules act within bounds, and those that observe the right of way do not crash."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from headway.contracts import Rule
from headway_envs.intersection.config import CLEAR_S, GREEN_S, STEP_S
from headway_envs.intersection.entry import ENTRY
from headway_envs.intersection.env import IntersectionBatchedEnv
from headway_envs.intersection.network import ROAD_M
from headway_envs.intersection.rules import Reservation, VirtualSignal
from headway_envs.sumo_simulation import libsumo

Open = Callable[..., Any]


def _played(env: IntersectionBatchedEnv, rule: Rule, seed: int) -> dict[str, float]:
    observed = env.reset(np.array([seed], np.uint64))
    while True:
        actions = rule.act(env, observed)
        assert actions.shape == (1, 96, 1)
        assert np.abs(actions).max() <= 3
        outcome, observed = env.step(actions)
        if outcome.episode_ended[0]:
            return dict(zip(env.spec.metrics, outcome.metrics[0].tolist(), strict=True))


@pytest.mark.parametrize("name", sorted(ENTRY.rules))
def test_every_rule_plays(name: str, crossing: Open) -> None:
    env = crossing(horizon=300)
    metrics = _played(env, ENTRY.rules[name].make(env.prepared), 1)
    assert all(np.isfinite(list(metrics.values())))
    assert metrics["avs"] > 5


@pytest.mark.slow
def test_humans_observe_the_right_of_way_and_full_throttle_does_not(crossing: Open) -> None:
    env, crashes = crossing(horizon=1200), {}
    for name in ("human", "reservation", "full_throttle"):
        rule = ENTRY.rules[name].make(env.prepared)
        crashes[name] = [_played(env, rule, seed)["collisions"] for seed in (1, 2)]
    assert sum(crashes["human"]) == 0
    assert sum(crashes["full_throttle"]) >= 2
    assert sum(crashes["reservation"]) < sum(crashes["full_throttle"])


@pytest.mark.slow
@pytest.mark.parametrize("action_repeat", [1, 10])
def test_the_virtual_signal_has_more_outflow_than_right_of_way(action_repeat: int, crossing: Open) -> None:
    """Humans queue behind holding AVs while the minor road, which would otherwise wait long, has green."""
    through, worst, crashes = {}, {}, 0.0
    for name in ("human", "virtual_signal"):
        env = crossing(av_speed_mode=11, action_repeat=action_repeat)
        rule = ENTRY.rules[name].make(env.prepared)
        played = [_played(env, rule, seed) for seed in (1, 2)]
        env.close()
        through[name] = np.mean([metrics["outflow_vph"] for metrics in played])
        worst[name] = np.mean([metrics["worst_approach_s"] for metrics in played])
        crashes += sum(metrics["collisions"] for metrics in played)
    assert crashes == 0
    assert through["virtual_signal"] > 1.1 * through["human"]
    assert worst["virtual_signal"] < 0.5 * worst["human"]


def test_with_a_share_the_other_avs_drive_as_without_a_signal(crossing: Open) -> None:
    """Each vehicle either always complies or never; with a share of 0 the signal has no effect."""
    env = crossing(av_speed_mode=11)
    all_keep, none = VirtualSignal(env.prepared), VirtualSignal(env.prepared, 0)
    half = ENTRY.rules["virtual_signal_0.5"].make(env.prepared)
    observed = env.reset(np.array([3], np.uint64))
    kept: dict[str, bool] = {}
    for _ in range(1499):
        _, observed = env.step(none.act(env, observed))
        actions = [rule.act(env, observed)[0, :, 0] for rule in (all_keep, half, none)]
        for _, slot, vehicle in env.bridge.roster.automated:
            keeps, asked, drives = (found[slot] for found in actions)
            if keeps != drives:
                assert asked in (keeps, drives)
                assert kept.setdefault(vehicle, asked == keeps) == (asked == keeps)
            else:
                assert asked == drives
    assert len(kept) > 30
    assert 0.3 < np.mean(list(kept.values())) < 0.7


def test_compliance_is_drawn_per_vehicle_and_episode() -> None:
    """It is neither periodic nor the same in all episodes."""
    rule = VirtualSignal(None, 0.25)
    vehicles = [f"av.{lane}.{number}" for lane in range(8) for number in range(50)]
    days = np.array([[rule._complies(vehicle, (day, 0)) for vehicle in vehicles] for day in range(20)])
    assert days.mean() == pytest.approx(0.25, abs=0.02)
    assert days.mean(axis=0).max() < 0.7
    gaps = np.diff(np.flatnonzero(days[0]))
    assert np.std(gaps) == pytest.approx(np.sqrt(0.75) / 0.25, rel=0.4)  # geometric


def test_avs_at_red_hold_far_before_the_stop_line(crossing: Open) -> None:
    """The road has AVs only: a vehicle that could hold when its green ended does not enter before its next
    green."""
    env, rule = crossing(vph_per_lane_hdv=0, av_speed_mode=11), VirtualSignal(None)
    observed = env.reset(np.array([3], np.uint64))
    half_s = GREEN_S + CLEAR_S
    before: dict[str, float] = {}
    too_near: set[str] = set()
    entered = held = 0
    for step in range(1499):
        _, observed = env.step(rule.act(env, observed))
        roster, (turn, since) = env.bridge.roster, divmod(step * STEP_S, half_s)
        there = {vehicle: row for row, _, vehicle in roster.automated}
        position, speed = roster.traffic.position, roster.traffic.speed
        if abs(since - GREEN_S) < STEP_S / 2:
            too_near = {
                vehicle
                for vehicle, row in there.items()
                if speed[row] ** 2 > 6 * (ROAD_M - rule.HOLD_M + rule.MARGIN_M - position[row])
            }
        for vehicle, row in there.items():
            red = roster.traffic.link[row] // 4 % 2 != int(turn) % 2 or since >= GREEN_S
            passes = before.get(vehicle, position[row]) < ROAD_M <= position[row]
            entered += passes
            assert not (passes and red) or vehicle in too_near
            held += red and speed[row] < 0.1 and abs(ROAD_M - rule.HOLD_M - position[row]) < rule.MARGIN_M
        before = {vehicle: float(position[row]) for vehicle, row in there.items()}
    assert entered > 20
    assert held > 1000


def test_handed_over_vehicles_are_humans_to_sumo(crossing: Open) -> None:
    env, sumo = crossing(horizon=600), libsumo()
    rule, observed = ENTRY.rules["human"].make(env.prepared), env.reset(np.array([1], np.uint64))
    for step in range(300):
        actions = rule.act(env, observed) if step >= 150 else np.zeros((1, 96, 1), np.float32)
        _, observed = env.step(actions)
    assert observed.alive.any()
    for vehicle in env.bridge.roster.ids:
        assert sumo.vehicle.getTypeID(vehicle) == "hdv"
        assert sumo.vehicle.getSpeedMode(vehicle) == 31


def test_reservations_exclude_conflicts(crossing: Open) -> None:
    """Two AVs on conflicting paths are never inside the junction at once."""
    env, rule = crossing(vph_per_lane_hdv=0, horizon=1200), Reservation(None)
    observed, foes = env.reset(np.array([2], np.uint64)), env.prepared.network.foes
    inside_at_once = crossed = 0
    for _ in range(1199):
        _, observed = env.step(rule.act(env, observed))
        traffic, count = env.bridge.roster.traffic, len(env.bridge.roster)
        link, position = traffic.link[:count], traffic.position[:count]
        rows = np.flatnonzero((position > 201) & (position < 200 + env.prepared.network.link_length[link]))
        crossed += len(rows)
        inside_at_once += foes[np.ix_(link[rows], link[rows])].sum()
    assert crossed > 200
    assert inside_at_once == 0
    assert env.counters.crashes == 0
