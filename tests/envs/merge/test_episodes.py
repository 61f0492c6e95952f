"""Starts and ends of episodes, and the differences between the presets."""

from typing import Any

import numpy as np
import pytest
from merging import make
from played import repeated

from headway_envs.merge.config import CAVS, HDVS, PRESETS
from headway_envs.merge.entry import ENTRIES
from headway_envs.merge.kernel.contact import outlines, shrunk_overlap
from headway_envs.merge.kernel.layout import AS_HUMAN, CAR, IDLE
from headway_envs.merge.network import build


@pytest.mark.parametrize("density", [1, 2, 3])
def test_traffic_is_drawn_by_density(density: int) -> None:
    """Every number of the range occurs, half of each kind on the highway, at places 40 m apart."""
    env = make(copies=400, density=density)
    episodes, cars = env.world.episodes, env.world.cars
    humans = episodes["cars"] - episodes["cavs"]
    assert set(episodes["cavs"]) == set(range(CAVS[density][0], CAVS[density][1] + 1))
    assert set(humans) == set(range(HDVS[density][0], HDVS[density][1] + 1))
    places: set[int] = set()
    for episode, row in zip(episodes, cars, strict=True):
        there = row[: episode["cars"]]
        for group in (there[: episode["cavs"]], there[episode["cavs"] :]):
            assert (group["y"] == 0).sum() == len(group) // 2
            assert (group["y"][len(group) // 2 :] == 10.5).all()
        assert ((there["speed"] >= 25) & (there["speed"] < 27)).all()
        for y, first in ((0.0, 10), (10.5, 5)):
            taken = np.rint((there["x"][there["y"] == y] - first) / 40).astype(int)
            assert len(set(taken)) == len(taken)
            assert np.abs(there["x"][there["y"] == y] - first - 40 * taken).max(initial=0) <= 1.5
            places |= set(taken)
    assert places == set(range(6))


def test_half_of_the_ramp_vehicles_start_on_the_outer_lane() -> None:
    env = make("merge_two_lane", copies=400, density=3)
    y = np.concatenate(
        [row["y"][: episode["cars"]] for episode, row in zip(env.world.episodes, env.world.cars, strict=True)]
    )
    assert 0.45 < (y == 14.5).sum() / (y > 0).sum() < 0.55


def test_the_number_of_cavs_can_be_set() -> None:
    env = make(copies=20, density=1, cavs=5)
    assert env.spec.num_agents == 5
    assert (env.world.episodes["cavs"] == 5).all()
    assert env.observed().alive.all()


@pytest.mark.parametrize("name", ENTRIES)
def test_the_time_limit_truncates_or_terminates_by_preset(name: str) -> None:
    for preset, terminal in (("clean", False), ("paper", True)):
        env, crashed = make(name, copies=32, preset=preset), np.zeros(32, np.bool_)
        for _ in range(99):
            crashed |= repeated(env, AS_HUMAN, 1).episode_ended
        outcome, late = repeated(env, AS_HUMAN, 1), ~crashed
        assert late.mean() > 0.8
        assert outcome.episode_ended[late].all()
        assert (outcome.terminated[late] == terminal).all()
        assert (outcome.truncated[late] != terminal).all()


def test_the_last_step_of_the_paper_has_one_simulation_step() -> None:
    """It is 298 in 100 steps instead of 300."""
    final = {}
    for preset in PRESETS:
        env = make(preset=preset, density=1, steps=2)
        x = env.world.cars[0, 0]["x"].copy()
        outcome = repeated(env, IDLE, 2)
        assert outcome.episode_ended[0]
        final[preset] = outcome.final_observations[0, 0, 1] * 150 - x
    assert final["clean"] / final["paper"] == pytest.approx(6 / 4, rel=0.01)


def _centre(lane: np.void, x: Any) -> Any:  # noqa: ANN401 - number or array
    """Return y of a lane's centre at x."""
    return lane["y"] + lane["amplitude"] * np.sin(lane["pulsation"] * (x - lane["x"]) + lane["phase"])


def test_the_papers_vehicles_turn_less_sharply() -> None:
    """The slip angle, used as steering angle, is about half of it: vehicles deviate further in the bend."""
    off = {}
    for preset in PRESETS:
        env, farthest = make(preset=preset, density=1), 0.0
        bend = env.network.lanes[5]
        assert bend["amplitude"] > 0
        for _ in range(60):
            repeated(env, AS_HUMAN, 1)
            cars = env.world.cars[0][: env.world.episodes[0]["cars"]]
            cars = cars[cars["lane"] == 5]
            farthest = max(farthest, np.abs(cars["y"] - _centre(bend, cars["x"])).max(initial=0.0))
        off[preset] = farthest
    assert 0 < off["clean"] < 0.8 * off["paper"]


def _car(x: float, y: float, heading: float = 0.0) -> np.void:
    car = np.zeros(1, CAR)[0]
    car["x"], car["y"], car["heading"] = x, y, heading
    car["cosine"], car["sine"] = np.cos(heading), np.sin(heading)
    return car


@pytest.mark.parametrize(
    ("x", "y", "heading", "whole", "shrunk"),
    [
        (4.9, 0.0, 0.0, True, False),  # bumper to bumper: 4.5 m when shrunk
        (4.4, 0.0, 0.0, True, True),
        (5.1, 0.0, 0.0, False, False),
        (0.0, 1.9, 0.0, True, False),
        (0.0, 1.7, 0.0, True, True),
        (3.4, 0.0, np.pi / 2, True, False),  # across: 2.5 + 1 m, 2.25 + 0.9 m when shrunk
        (3.1, 0.0, np.pi / 2, True, True),
        (3.6, 0.0, np.pi / 2, False, False),
    ],
)
def test_contacts_of_exact_and_shrunk_outlines(
    x: float, y: float, heading: float, whole: bool, shrunk: bool
) -> None:
    here, there = _car(0, 0), _car(x, y, heading)
    assert outlines(here, there, 5.0, 2.0, 0.0, 0.0)[0] == whole
    assert shrunk_overlap(here, there, False) == shrunk
    assert shrunk_overlap(there, here, False) == shrunk


def test_vehicles_about_to_intersect_are_pushed_apart() -> None:
    """The rear vehicle would overlap the front one by 0.5 m, which is the displacement."""
    meets, will_meet, push_x, push_y = outlines(_car(0, 0), _car(5.3, 0), 5.0, 2.0, 0.8, 0.0)
    assert (meets, will_meet) == (False, True)
    assert (push_x, push_y) == pytest.approx((-0.5, 0.0))


def test_lanes_are_connected() -> None:
    """The successor of a lane begins where the lane ends."""
    for ramp_lanes in (1, 2):
        net = build(ramp_lanes)
        for lane in net.lanes:
            following = net.lanes[lane["successor"]]
            if following == lane or lane["merging"]:
                continue
            x = lane["x"] + lane["length"]
            assert following["x"] == x
            assert _centre(lane, x) == pytest.approx(_centre(following, x))
        assert net.obstacles.tolist() == [[420.0, 4.0], [420.0, 8.0]][:ramp_lanes]


def test_without_the_tie_gain_few_vehicles_leave_the_outer_ramp_lane() -> None:
    """Both ramp lanes end at the same place, so that a change gains nothing otherwise."""
    merged = {}
    for tie in (0.21, 0.0):
        env = make("merge_two_lane", copies=64, density=1)
        env.settings["tie_gain"] = tie
        outer = [env.world.cars[c]["y"][env.world.episodes[c]["cars"] - 1] == 14.5 for c in range(64)]
        repeated(env, AS_HUMAN, 99)
        y = env.world.cars["y"][np.arange(64), env.world.episodes["cars"] - 1]
        merged[tie] = (y[outer] < 6).mean()
    assert merged[0.21] > 0.6
    assert merged[0.0] < 0.4
