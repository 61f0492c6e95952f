"""Observations, masks and rewards compared with a plain Python implementation of their definitions."""

import math
from typing import Any

import numpy as np
import pytest
from merging import make
from played import repeated

from headway_envs.merge.config import RewardConfig
from headway_envs.merge.env import MergeBatchedEnv
from headway_envs.merge.kernel.layout import IDLE, LEFT, RIGHT

Car = Any
NAMES = {
    "merge": ["ab", "bc0", "bc1", "cd", "jk", "kb"],
    "merge_two_lane": ["ab", "bc0", "bc1", "bc2", "cd", "jk", "kb", "mn", "nb"],
}
FOLLOWS = {"ab": "bc0", "bc0": "cd", "jk": "kb", "kb": "bc1", "mn": "nb", "nb": "bc2"}
NEAR = {
    "ab": {"ab", "bc0"},
    "bc0": {"ab", "bc0", "cd"},
    "cd": {"bc0", "cd"},
    "jk": {"jk", "kb"},
    "kb": {"jk", "kb", "bc1"},
    "bc1": {"kb", "bc1"},
    "mn": {"mn", "nb"},
    "nb": {"mn", "nb", "bc2"},
    "bc2": {"nb", "bc2"},
}
SIDES = {
    "ab": ("ab", "kb"), "bc0": ("bc0", "bc1"), "cd": ("cd", None), "jk": (None, "jk"), "kb": ("ab", "kb"),
    "bc1": ("bc0", "bc1"), "mn": (None, "mn"), "nb": ("kb", "nb"), "bc2": ("bc1", "bc2"),
}  # fmt: skip


def cars_of(env: MergeBatchedEnv, copy: int) -> tuple[list[Car], int, list[str]]:
    """Return the vehicles of a copy, the number of CAVs, and the name of each vehicle's lane."""
    episode = env.world.episodes[copy]
    cars = list(env.world.cars[copy][: episode["cars"]])
    names = NAMES[env.spec.name]
    return cars, int(episode["cavs"]), [names[car["lane"]] for car in cars]


def velocity(car: Car) -> tuple[float, float]:
    return car["speed"] * math.cos(car["heading"]), car["speed"] * math.sin(car["heading"])


def observation(cars: list[Car], index: int) -> list[float]:
    ego, (vx, vy) = cars[index], velocity(cars[index])
    rows = [[1.0, ego["x"] / 150, ego["y"] / 12, vx / 45, vy / 45]]
    others = [
        car
        for i, car in enumerate(cars)
        if i != index and math.hypot(car["x"] - ego["x"], car["y"] - ego["y"]) < 180
    ]
    for car in sorted(others, key=lambda car: abs(car["x"] - ego["x"]))[:4]:
        ux, uy = velocity(car)
        dx, dy = car["x"] - ego["x"], car["y"] - ego["y"]
        rows.append([1.0, dx / 150, dy / 12, (ux - vx) / 45, (uy - vy) / 45])
    rows += [[0.0] * 5] * (5 - len(rows))
    return [value for row in rows for value in row]


def own_reward(cars: list[Car], lanes: list[str], index: int) -> float:
    ego, lane = cars[index], lanes[index]
    ahead = {lane, FOLLOWS.get(lane, lane)}
    gaps = [car["x"] - ego["x"] for car, other in zip(cars, lanes, strict=True) if other in ahead]
    gap = min([60.0, *(gap for gap in gaps if gap > 0)])
    reward = -200.0 * ego["crashed"] + min(max((ego["speed"] - 10) / 20, 0), 1)
    if lane in ("bc1", "bc2"):
        reward -= 4 * math.exp(-((ego["x"] - 420) ** 2) / 1000)
    return reward + (4 * min(0.0, math.log(gap / (1.2 * ego["speed"]))) if ego["speed"] > 0 else 0.0)


def next_to(cars: list[Car], lanes: list[str], index: int) -> list[int]:
    left, right = SIDES[lanes[index]]
    if lanes[index] == "ab" and cars[index]["x"] <= 220:
        right = None
    found = []
    for lane in (left, right):
        there = [i for i in range(len(cars)) if lane and i != index and lanes[i] in NEAR[lane]]
        ahead = [i for i in there if cars[i]["x"] > cars[index]["x"]]
        behind = [i for i in there if cars[i]["x"] <= cars[index]["x"]]
        found += [min(ahead, key=lambda i: cars[i]["x"])] if ahead else []
        found += [max(behind, key=lambda i: cars[i]["x"])] if behind else []
    return found


def reward(cars: list[Car], lanes: list[str], cavs: int, index: int, scope: str) -> float:
    own = [own_reward(cars, lanes, i) for i in range(cavs)]
    if scope == "global":
        return sum(own) / cavs
    if scope == "own":
        return own[index] if index < cavs else 0.0
    if index >= cavs:
        return 0.0
    region = [own[index], *(own[i] for i in next_to(cars, lanes, index) if i < cavs)]
    return sum(region) / len(region)


@pytest.mark.parametrize(
    ("name", "scope"),
    [("merge", "own"), ("merge", "global"), ("merge", "regional"), ("merge_two_lane", "regional")],
)
def test_rewards_and_observations_are_as_defined(name: str, scope: str) -> None:
    env = make(name, copies=6, density=3, reward=RewardConfig(scope=scope))
    observed, draw, lanes_seen = env.observed(), np.random.default_rng(1), set()
    for _ in range(90):
        for copy in range(env.num_copies):
            cars, cavs, lanes = cars_of(env, copy)
            assert observed.alive[copy].tolist() == [n < cavs for n in range(env.spec.num_agents)]
            for index in range(cavs):
                np.testing.assert_allclose(
                    observed.observations[copy, index], observation(cars, index), rtol=1e-5, atol=1e-6
                )
            assert (observed.observations[copy, cavs:] == 0).all()
        outcome, observed = env.step(draw.choice(5, (6, 6), p=[0.1, 0.6, 0.1, 0.1, 0.1]))
        for copy in np.flatnonzero(~outcome.episode_ended):
            cars, cavs, lanes = cars_of(env, copy)
            lanes_seen |= set(lanes[:cavs])
            for index in range(env.spec.num_agents):
                wanted = reward(cars, lanes, cavs, index, scope)
                assert outcome.rewards[copy, index] == pytest.approx(wanted, rel=1e-4, abs=1e-4)
    assert lanes_seen == set(NAMES[name])


def test_a_crash_costs_its_weight_and_ends_the_episode_for_all() -> None:
    """Idle CAVs on the ramp hit its end."""
    env = make(copies=8, density=1, reward=RewardConfig(scope="own"))
    crashes = 0
    for _ in range(100):
        outcome = repeated(env, IDLE, 1)
        ended = outcome.episode_ended
        if ended.any():
            crashes += ended.sum()
            assert outcome.terminated[ended].all()
            assert not outcome.truncated[ended].any()
            assert (outcome.rewards[ended].min(axis=1) < -195).all()
            assert (outcome.metrics[ended, env.spec.metrics.index("crash_rate")] == 1).all()
    assert crashes >= 8


def test_the_state_holds_every_vehicle_and_the_time() -> None:
    env = make("merge_two_lane", copies=3, density=2)
    repeated(env, IDLE, 7)
    observed = env.observed()
    for copy in range(3):
        cars, cavs, _ = cars_of(env, copy)
        rows, time = observed.states[copy, :-1].reshape(8, 7), observed.states[copy, -1]
        assert time == pytest.approx(0.07)
        slots = [*range(cavs), *range(4, 4 + len(cars) - cavs)]
        assert np.flatnonzero(rows[:, 0]).tolist() == slots
        for row, car in zip(rows[slots], cars, strict=True):
            np.testing.assert_allclose(row[1:3], [car["x"] / 150, car["y"] / 12], rtol=1e-6)
            np.testing.assert_allclose(row[3:5], np.array(velocity(car)) / 45, rtol=1e-5, atol=1e-7)


def test_with_two_ramp_lanes_only_changes_to_the_left_are_allowed() -> None:
    env = make("merge_two_lane", copies=32, density=1)
    cars_from_outer = False
    for _ in range(99):
        observed = env.observed()
        assert observed.action_masks is not None
        masks = observed.action_masks
        assert not masks[..., RIGHT][observed.alive].any()
        for copy in range(32):
            cars, cavs, lanes = cars_of(env, copy)
            for index in range(cavs):
                beside = lanes[index] in ("bc1", "bc2") and 320 <= cars[index]["x"] < 425
                assert masks[copy, index, LEFT] == beside
                cars_from_outer |= lanes[index] == "bc0" and abs(cars[index]["y"]) > 0.5
        env.step(np.where(masks[..., LEFT], LEFT, 1))
    assert cars_from_outer


@pytest.mark.parametrize("density", [1, 2, 3])
def test_room_for_more_vehicles_changes_only_where_the_state_has_them(density: int) -> None:
    """Some episodes of either, with the same actions."""
    exact, roomy = make(copies=4, density=density), make(copies=4, density=density, max_density=3)
    slots = len(exact.spec.agents)
    assert (len(roomy.spec.agents), roomy.spec.state_size) == (6, 7 * (6 + 5) + 1)
    draw = np.random.default_rng(3)
    for _ in range(60):
        actions = draw.integers(0, 5, (4, 6))
        ours, ours_seen = exact.step(actions[:, :slots])
        theirs, seen = roomy.step(actions)
        np.testing.assert_array_equal(theirs.metrics, ours.metrics)
        np.testing.assert_array_equal(theirs.rewards[:, :slots], ours.rewards)
        np.testing.assert_array_equal(theirs.terminated[:, :slots], ours.terminated)
        np.testing.assert_array_equal(seen.observations[:, :slots], ours_seen.observations)
        assert not seen.alive[:, slots:].any()
        # CAVs, then HDVs, in blocks of 7 numbers; the last number is the time.
        blocks = [states[:, :-1].reshape(4, -1, 7) for states in (ours_seen.states, seen.states)]
        hdvs = blocks[0].shape[1] - slots
        np.testing.assert_array_equal(blocks[1][:, :slots], blocks[0][:, :slots])
        np.testing.assert_array_equal(blocks[1][:, 6 : 6 + hdvs], blocks[0][:, slots:])
        assert not blocks[1][:, slots:6].any()
        assert not blocks[1][:, 6 + hdvs :].any()
        np.testing.assert_array_equal(seen.states[:, -1], ours_seen.states[:, -1])
    assert make(density=density, max_density=density).spec == make(density=density).spec
