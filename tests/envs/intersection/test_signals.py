"""Observations and rewards of automated vehicles, compared with the equations and with SUMO."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from played import begun

from headway_envs.intersection import kernel
from headway_envs.intersection.config import TERMS, IntersectionConfig, RewardConfig
from headway_envs.intersection.episode_metrics import EpisodeMetrics, jain
from headway_envs.intersection.layout import (
    ACCOUNT,
    CROSSING,
    EXTENDED_SIZE,
    REWARD_OWN,
    REWARD_PAPER,
    REWARD_TEAM,
    SCRATCH,
    SUMS,
    TRAFFIC,
    Slots,
    StepEvents,
    Traffic,
)
from headway_envs.intersection.metrics import METRICS
from headway_envs.intersection.sumo.human_drivers import acceleration
from headway_envs.sumo_simulation import libsumo

Open = Callable[..., Any]
SEED, ONES = np.array([3], np.uint64), np.ones((1, 96, 1), np.float32)
LENGTH = 1796.72
"""Total length of the network's edges, m."""


def test_the_papers_observation_agrees_with_sumo(crossing: Open) -> None:
    env, sumo = crossing(observation="paper", horizon=900), libsumo()
    observed = env.reset(SEED)
    draw, followed = np.random.default_rng(0), 0
    for step in range(800):
        _, observed = env.step(draw.normal(1, 2, (1, 96, 1)).astype(np.float32))
        for _, slot, vehicle in env.bridge.roster.automated if step % 20 == 0 else ():
            speed = sumo.vehicle.getSpeed(vehicle)
            leader, follower = sumo.vehicle.getLeader(vehicle, 200), sumo.vehicle.getFollower(vehicle, 200)
            ahead = (sumo.vehicle.getSpeed(leader[0]), leader[1] + 2.5) if leader else (30.0, LENGTH)
            behind = (sumo.vehicle.getSpeed(follower[0]), follower[1] + 2.5) if follower[0] else (0.0, LENGTH)
            followed += bool(leader) and bool(follower[0])
            front = [(ahead[0] - speed) / 30, ahead[1] / LENGTH]
            back = [(speed - behind[0]) / 30, behind[1] / LENGTH]
            expected = [speed / 30, *front, *back]
            np.testing.assert_allclose(observed.observations[0, slot, 1:], expected, rtol=0, atol=1e-6)
            if not sumo.vehicle.getRoadID(vehicle).startswith(":"):
                place = sumo.vehicle.getLanePosition(vehicle) / LENGTH
                assert observed.observations[0, slot, 0] == pytest.approx(place, abs=1e-6)
    assert followed > 50


def _random_traffic(seed: int, count: int) -> Traffic:
    draw, traffic = np.random.default_rng(seed), Traffic.of(np.zeros(1, TRAFFIC))
    traffic.position[:count] = draw.uniform(0, 420, count)
    traffic.speed[:count] = np.where(draw.random(count) < 0.2, 0.0, draw.uniform(0, 25, count))
    traffic.before[:count] = draw.uniform(0, 25, count)
    traffic.fuel[:count] = draw.uniform(0, 3, count)
    traffic.link[:count] = draw.integers(0, 16, count)
    traffic.slot[:count] = np.where(draw.random(count) < 0.5, draw.permutation(96)[:count], -1)
    traffic.around[:count, 0::2] = draw.integers(-1, count, (count, 2))
    traffic.around[:count, 1::2] = draw.uniform(0, 30, (count, 2))
    return traffic


def _after_step(
    traffic: Traffic, count: int, events: StepEvents, reward_kind: int = REWARD_TEAM
) -> tuple[np.void, Slots]:
    """Return the account and the arrays by slot after a step to this traffic; every other slot was acting."""
    crossing, memory, account, scratch = (
        np.zeros(1, dtype) for dtype in (CROSSING, TRAFFIC, ACCOUNT, SCRATCH)
    )
    slots, draw = Slots.empty(96, EXTENDED_SIZE), np.random.default_rng(9)
    slots.acting[::2] = True
    foes = draw.random((16, 16)) < 0.5
    crossing["link_length"], crossing["total_length"], crossing["weights"] = 20.8, LENGTH, 1
    crossing["foes"], crossing["yields"] = foes | foes.T, foes
    crossing["extended"], crossing["reward_kind"] = True, reward_kind
    memory["speed"], memory["slot"], memory["link"] = traffic.before, traffic.slot, traffic.link
    around = traffic.around[:count][traffic.slot[:count] >= 0]
    readings = [column[:count] for column in (traffic.speed, traffic.position, traffic.fuel)]
    values = np.concatenate([*readings, around.ravel()])
    kernel.process_step(crossing, memory, account, scratch, *slots, count, values, *events)
    for read, given in zip(Traffic.of(memory)[:4], traffic[:4], strict=True):
        assert (read == given).all()
    return account[0], slots


def test_target_speeds_follow_from_clipped_accelerations() -> None:
    """Speeds are in the order of rows: slot 4 belongs to row 0, and so on; no speed is negative."""
    memory = np.zeros(1, TRAFFIC)
    memory["slot"][0, :6], memory["speed"][0, :6] = [4, -1, 0, 3, 1, 2], [0.1, 9.0, 10.0, 12.0, 11.0, 13.0]
    accelerations = np.array([9.0, 0.7, 8.0, -8.0, -2.0], np.float32)
    acting, targets = np.array([True, True, False, True, True]), np.full(6, 7.0)
    kernel.target_speeds(accelerations, acting, memory, 6, targets)
    tenth = np.float32(0.1)
    change = [np.float32(3) * tenth, np.float32(-3) * tenth, np.float32(0.7) * tenth]
    expected = [0.0, 10.0 + float(change[0]), 12.0 + float(change[1]), 11.0 + float(change[2]), 13.0]
    assert targets.tolist() == [*expected, 7.0]


def test_actions_of_another_shape_are_refused(crossing: Open) -> None:
    env = begun(crossing(horizon=20), 3)
    with pytest.raises(ValueError, match=r"actions must have shape \(1, 96, 1\), not \(1, 95, 1\)"):
        env.step(np.zeros((1, 95, 1), np.float32))


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("crashes", [0, 2])
def test_the_papers_terms_follow_its_equations(seed: int, crashes: int) -> None:
    """Equations 7 to 12 of the paper, in its vector form."""
    count, traffic = 17, _random_traffic(seed, 17)
    paper = _after_step(traffic, count, StepEvents(1, crashes, 3, 420.0, 5, 0.5))[0]["paper"]
    v, automated = traffic.speed[:count], traffic.slot[:count] >= 0
    targets = np.full(count, 20.0)
    nearness = np.linalg.norm(targets) - np.linalg.norm(v - targets)
    velocity = max(nearness / (np.linalg.norm(targets) + 1e-5), 0.0)
    most = 0.1 * count
    cost = 0.1 * ((30 - v) / 30).sum()
    following = automated & (traffic.around[:count, 0] >= 0) & (v > 0)
    times = (traffic.around[:count, 1][following] + 2.5) / v[following]
    expected = [
        0.0 if crashes else velocity,
        -0.5 * (v == 0).sum(),
        0.5 * np.abs(v[automated]).sum(),
        0.5 * max((most - cost) / (most + 1e-5), 0.0),
        -0.5 * 3,
        0.5 * 420.0,
        np.minimum(times - 1.0, 0).sum(),
        0.0,
    ]
    np.testing.assert_allclose(paper, expected, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("seed", range(2))
def test_scaled_terms_lie_between_minus_one_and_one(seed: int) -> None:
    count, traffic = 17, _random_traffic(seed, 17)
    v, automated = traffic.speed[:count], traffic.slot[:count] >= 0
    account, _ = _after_step(traffic, count, StepEvents(3, 2, 1, 420.0, 5, 0.5))
    scaled = dict(zip(TERMS, account["scaled"], strict=True))
    assert max(map(abs, scaled.values())) <= 1
    assert scaled["standstill"] == pytest.approx(-(v < 0.1).mean())
    assert scaled["progress"] == pytest.approx(v[automated].mean() / 30)
    assert scaled["delay"] == pytest.approx(v.mean() / 30, abs=1e-4)
    assert scaled["lane_change"] == pytest.approx(-1 / automated.sum())
    assert scaled["throughput"] == 1
    assert scaled["collision"] == -1
    empty, _ = _after_step(_random_traffic(seed, 0), 0, StepEvents())
    assert (empty["scaled"] == 0).all()
    assert (empty["paper"] == 0).all()


@pytest.mark.parametrize("reward_kind", [REWARD_PAPER, REWARD_TEAM, REWARD_OWN])
def test_paper_and_own_rewards_go_to_acting_avs_on_the_road(reward_kind: int) -> None:
    count, traffic = 17, _random_traffic(2, 17)
    account, slots = _after_step(traffic, count, StepEvents(1, 0, 0, 420.0, 5, 0.5), reward_kind)
    there = slots.acting & slots.alive
    assert 0 < there.sum() < slots.alive.sum()
    paper = account["paper_return"] / there.sum()
    returned = paper if reward_kind == REWARD_PAPER else account["scaled"].sum()
    assert account["team_return"] == pytest.approx(returned)
    terms = account["paper"] if reward_kind == REWARD_PAPER else account["scaled"]
    assert (account["terms"] == terms).all()
    if reward_kind == REWARD_TEAM:
        np.testing.assert_allclose(slots.rewards, returned, rtol=1e-6)
        return
    assert (slots.rewards[~there] == 0).all()
    if reward_kind == REWARD_PAPER:
        np.testing.assert_allclose(slots.rewards[there], paper, rtol=1e-6)
    else:
        assert len(set(slots.rewards[there])) == there.sum()


@pytest.mark.parametrize("seed", range(2))
def test_an_extended_observation_shows_the_next_vehicles_on_conflicting_paths(seed: int) -> None:
    count, traffic = 25, _random_traffic(seed, 25)
    (_, slots), draw = _after_step(traffic, count, StepEvents()), np.random.default_rng(9)
    position, speed, link, slot = traffic.position, traffic.speed, traffic.link, traffic.slot
    yields = draw.random((16, 16)) < 0.5
    foes = yields | yields.T
    until = np.minimum(np.maximum(200 - position, 0) / np.maximum(speed, 0.1), 20)
    shown = hidden = 0
    for row in np.flatnonzero(slot[:count] >= 0):
        seen = slots.observations[slot[row]]
        before, beyond = position[row] < 200, position[row] >= 220.8
        assert seen[6:9].tolist() == [before, not before and not beyond, beyond]
        assert seen[9] == pytest.approx(max(200 - position[row], 0) / 200, abs=1e-6)
        assert seen[11:14].argmax() == [0, 1, 1, 2][link[row] % 4]
        leader, ahead, follower, behind = traffic.around[row]
        near = [
            max(200 - position[row], 0) / 50,
            (ahead + 2.5) / 50 if leader >= 0 else 1,
            (ahead + 2.5) / max(speed[row], 0.1) / 5 if leader >= 0 else 1,
            (behind + 2.5) / 50 if follower >= 0 else 1,
        ]
        np.testing.assert_allclose(seen[14:18], np.minimum(near, 1), rtol=0, atol=1e-6)
        others = [
            other
            for other in range(count)
            if foes[link[row], link[other]] and max(position[other], position[row]) < 220.8
        ]
        heads: dict[object, int] = {}
        for other in others:
            lane = link[other] // 2 if position[other] < 200 else f"inside {other}"
            if lane not in heads or position[other] > position[heads[lane]]:
                heads[lane] = other
        expected = np.zeros((4, 6))
        nearest = sorted(heads.values(), key=lambda n: (200 - position[n]) / max(speed[n], 3))[:4]
        hidden += len(others) - len(nearest)
        shown += len(nearest)
        for place, other in enumerate(nearest):
            expected[place] = (
                1,
                (200 - position[other]) / 50,
                speed[other] / 30,
                (until[other] - until[row]) / 20,
                slot[other] >= 0,
                yields[link[row], link[other]],
            )
        np.testing.assert_allclose(seen[18:].reshape(4, 6), expected, rtol=0, atol=1e-6)
    assert shown > 5
    assert hidden > 0
    assert slots.alive.sum() == (slot[:count] >= 0).sum()
    assert (slots.observations[~slots.alive] == 0).all()


def test_the_state_counts_every_vehicle_once() -> None:
    count, traffic = 30, _random_traffic(1, 30)
    state = _after_step(traffic, count, StepEvents(pending=10, progress=0.25))[0]["state"]
    by_approach = state[:-2].reshape(4, 16)
    cells, beyond = by_approach[:, :12].reshape(4, 4, 3), by_approach[:, 12:].reshape(4, 2, 2)
    assert 10 * (cells[..., :2].sum() + beyond[..., 0].sum()) == pytest.approx(count, abs=1e-4)
    approach, cell = traffic.link[:count] // 4, traffic.position[:count] // 50
    for place in np.argwhere(cells[..., :2].any(axis=-1)).tolist():
        there = (approach == place[0]) & (cell == place[1])
        found = cells[tuple(place)]
        assert found[:2].sum() * 10 == pytest.approx(there.sum(), abs=1e-5)
        assert found[2] * 30 == pytest.approx(traffic.speed[:count][there].mean(), abs=1e-3)
    assert state[-2:].tolist() == [0.25, pytest.approx(0.2)]


def test_the_teams_return_is_the_sum_of_its_rewards_and_of_their_weighted_terms(crossing: Open) -> None:
    env, team = begun(crossing(horizon=300), 3), 0.0
    for _ in range(300):
        outcome, _ = env.step(ONES)
        assert (outcome.rewards == outcome.rewards[0, 0]).all()
        team += float(outcome.rewards[0, 0])
    metrics = dict(zip(METRICS, outcome.metrics[0].tolist(), strict=True))
    assert metrics["team_return"] == pytest.approx(team, rel=1e-4)
    terms = np.array([metrics[f"reward_{term}"] for term in TERMS])
    assert 300 * (RewardConfig().weights @ terms) == pytest.approx(team, rel=1e-4)


def test_the_papers_return_is_the_sum_of_rewards_which_avs_present_share_alike(crossing: Open) -> None:
    env, paper = crossing(reward=RewardConfig(kind="paper"), horizon=300), 0.0
    there = env.reset(SEED).alive[0].copy()
    for _ in range(300):
        outcome, observed = env.step(ONES)
        rewards = outcome.rewards[0]
        assert (rewards[~there] == 0).all()
        assert len(set(rewards[there & (rewards != 0)].tolist())) <= 1
        paper, there = paper + float(rewards.sum()), observed.alive[0].copy()
    assert dict(zip(METRICS, outcome.metrics[0], strict=True))["paper_return"] == pytest.approx(
        paper, rel=1e-4
    )


def test_own_rewards_depend_on_own_driving_and_crash(crossing: Open) -> None:
    reward = RewardConfig(scope="own", throughput=3.0, collision=7.0)
    env = crossing(reward=reward, horizon=900, av_speed_mode=0)
    assert not env.spec.shared_reward
    observed, seen = env.reset(SEED), {"arrived": 0, "collided": 0, "behind": 0}
    for _ in range(800):
        there, before = observed.alive[0].copy(), env.bridge.roster.holder.copy()
        outcome, observed = env.step(np.full((1, 96, 1), 2, np.float32))
        paid, traffic = outcome.rewards[0], env.bridge.roster.traffic
        assert (paid[~there] == 0).all()
        for slot, event in env.events.items():
            seen[event] += 1
            assert paid[slot] == (0.0 if event == "arrived" else -7.0)
        for row, slot, vehicle in env.bridge.roster.automated:
            if before[slot] != vehicle:
                continue
            speed, (leader, gap) = traffic.speed[row], traffic.around[row, :2]
            expected = 0.2 * max(1 - abs(speed - 20) / 20, 0) - 0.2 * (speed < 0.1) + 0.2 * min(speed / 30, 1)
            if leader >= 0 and speed > 0:
                seen["behind"] += 1
                expected += 0.1 * min((gap + 2.5) / speed - 1, 0)
            assert paid[slot] == pytest.approx(expected, abs=1e-6)
    assert min(seen.values()) > 0


def test_the_team_return_excludes_own_rewards(crossing: Open) -> None:
    def metrics(scope: str) -> dict[str, float]:
        env = begun(crossing(reward=RewardConfig(scope=scope), horizon=300), 3)
        for _ in range(300):
            outcome, _ = env.step(ONES)
        env.close()
        return dict(zip(METRICS, outcome.metrics[0].tolist(), strict=True))

    assert metrics("own") == metrics("team")


def test_fairness_is_jains_index_of_time_per_av_that_left() -> None:
    assert jain([3.0, 3.0, 3.0]) == pytest.approx(1.0)
    assert jain([5.0, 0.0, 0.0, 0.0]) == pytest.approx(0.25)
    assert jain([]) == 1.0
    counters = EpisodeMetrics(
        IntersectionConfig(), steps=1000, through=[2, 1, 0, 0], travel_s=[20.0, 30.0, 40.0]
    )
    account = np.zeros(1, ACCOUNT)
    account["present"] = 500.0, 400.0, 900.0, 0.0
    metrics = dict(zip(METRICS, counters.metrics(account[0]), strict=True))
    assert metrics["travel_time_av_s"] == pytest.approx(30)
    assert metrics["worst_approach_s"] == pytest.approx(90)  # no AV from there left
    assert metrics["fairness_jain"] == pytest.approx(jain([25.0, 40.0, 90.0]))


def test_means_are_over_vehicles_of_their_kind() -> None:
    count, traffic = 12, _random_traffic(3, 12)
    account, _ = _after_step(traffic, count, StepEvents())
    sums = {name: account[name] for name in SUMS}
    automated = traffic.slot[:count] >= 0
    change = (traffic.speed - traffic.before)[:count] / 0.1
    assert sums["speed_av"] == pytest.approx(traffic.speed[:count][automated].mean())
    assert sums["speed_hdv"] == pytest.approx(traffic.speed[:count][~automated].mean())
    assert sums["acceleration_av"] == pytest.approx(np.abs(change[automated]).mean())
    assert sums["hardest_braking_hdv"] == pytest.approx(-change[~automated].min())
    assert sums["fuel"] == pytest.approx(traffic.fuel[:count].mean())
    assert (sums["steps_all"], sums["steps_av"], sums["vehicles"]) == (1, 1, count)


def test_the_driver_model_has_the_equilibrium_gap_and_speed() -> None:
    """Equilibrium: at a common speed v the gap is (s0 + v T) / sqrt(1 - (v / v0)^4); alone it is v0."""
    v = np.array([5.0, 15.0, 25.0])
    gap = (2.0 + v) / np.sqrt(1 - (v / 30) ** 4)
    np.testing.assert_allclose(acceleration(v, v, gap), 0, atol=1e-12)
    alone = acceleration(np.array([30.0, 0.0]), np.zeros(2), np.full(2, np.inf))
    np.testing.assert_allclose(alone, [0.0, 1.0], atol=1e-12)
    assert (acceleration(v, v - 1, gap) < 0).all()
