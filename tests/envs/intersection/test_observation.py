"""Observations of platoons beside a naive loop over lanes, and the shared clock."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from headway_envs.intersection.entry import ENTRY
from headway_envs.intersection.env import IntersectionBatchedEnv
from headway_envs.intersection.network import APPROACHES, LINKS
from headway_envs.sumo_simulation import libsumo

Open = Callable[..., Any]
SEED = np.array([3], np.uint64)


def _naive(env: IntersectionBatchedEnv) -> NDArray[np.float32]:
    """Return the platoon observations of all slots, from SUMO's routes, lanes and positions."""
    sumo, found, lanes = libsumo().vehicle, np.zeros((96, 46), np.float32), [[] for _ in range(8)]
    roster, inside = env.bridge.roster, env.prepared.network.link_length
    for row, name in enumerate(roster.ids):
        approach, turn = sumo.getRouteID(name).split("_")
        link = int(roster.traffic.link[row])
        assert (link // 4, LINKS[link % 4][0]) == (APPROACHES.index(approach), turn)
        lane, place = sumo.getLaneID(name), sumo.getLanePosition(name)
        if not lane.startswith(":"):
            place += 200 + inside[link] if "_out" in lane else 0
            assert place == pytest.approx(roster.traffic.position[row], abs=1e-9)
        else:
            place = float(roster.traffic.position[row])  # several lanes inside
        lanes[link // 2].append((place, sumo.getSpeed(name), int(roster.traffic.slot[row])))
    queues = []
    for lane in lanes:
        queue = [[]]
        for vehicle in sorted(lane, reverse=True):
            if vehicle[2] >= 0:
                queue.append([])
            queue[-1].append(vehicle)
        queues.append(queue)
    for own, queue in enumerate(queues):
        for platoon in queue[1:]:
            past, pairs = platoon[0][0] > 200, []
            for place, speed, _ in (platoon[0], platoon[-1]):
                pairs.append((1.0 if past else (200 - place) / 200, speed / 30))
            for turn in range(1, 8):
                shown, other = [(0.0, 1.0), (1.0, 0.0), (1.0, 0.0)], queues[(own + turn) % 8]
                number = next((n for n, row in enumerate(other) for each in row if each[0] <= 200), None)
                if number is not None and not past:
                    first = next(each for each in other[number] if each[0] <= 200)
                    if first[2] < 0:
                        shown[0] = (200 - other[number][-1][0]) / 200, other[number][-1][1] / 30
                        number += 1
                    if number < len(other):
                        ends = other[number][0], other[number][-1]
                        shown[1:] = [((200 - place) / 200, speed / 30) for place, speed, _ in ends]
                pairs += shown
            found[platoon[0][2]] = 2 * np.clip(np.array(pairs).T.ravel(), 0, 1) - 1
    return found


@pytest.mark.parametrize("clock", [False, True])
def test_platoons_equal_a_naive_loop_over_lanes(clock: bool, crossing: Open) -> None:
    env, draw, seen = crossing(observation="platoons", clock=clock), np.random.default_rng(1), 0
    env.reset(SEED)
    for step in range(900):
        _, observed = env.step(draw.normal(1, 2, (1, 96, 1)).astype(np.float32))
        if step % 5 == 0:
            np.testing.assert_allclose(observed.observations[0, :, :46], _naive(env), rtol=0, atol=2e-6)
            seen += observed.alive.sum()
    assert seen > 1000


def test_the_clock_is_that_of_the_signal(crossing: Open) -> None:
    """At 17 s a quarter of the 68 s cycle has passed on the north-south road, and at 51 s on the other. The
    clock changes no other number."""
    with_clock, played = crossing(clock=True), []
    with_clock.reset(SEED)
    for step in range(1, 520):
        _, observed = with_clock.step(np.zeros((1, 96, 1), np.float32))
        played.append(observed.observations[0, :, :-2].copy())
        roster = with_clock.bridge.roster
        assert (observed.observations[0, ~observed.alive[0]] == 0).all()
        for row, slot, _ in roster.automated if step in (170, 510) else ():
            own = roster.traffic.link[row] // 4 in (0, 2)
            expected = [1.0 if own == (step == 170) else -1.0, 0.0]
            np.testing.assert_allclose(observed.observations[0, slot, -2:], expected, atol=1e-6)
    with_clock.close()
    without = crossing()
    without.reset(SEED)
    for expected in played:
        _, observed = without.step(np.zeros((1, 96, 1), np.float32))
        assert (observed.observations[0] == expected).all()


def test_the_virtual_signal_is_a_function_of_an_avs_observation_with_the_clock(crossing: Open) -> None:
    """Its actions are computed again from single observations, by the rule's description."""
    env = crossing(clock=True, av_speed_mode=11, action_repeat=10)
    rule, place = ENTRY.rules["virtual_signal"].make(env.prepared), {}
    for number, feature in enumerate(env.spec.observation_features):
        place[feature.name] = number, feature.scale

    def of(row: NDArray[np.float32], name: str) -> float:
        number, scale = place[name]
        return float(row[number]) * scale

    turn_speeds = dict(zip(("right", "straight"), env.prepared.network.link_speed[:2], strict=True))
    turn_speeds["left"] = env.prepared.network.link_speed[3]
    observed, held, free = env.reset(SEED), 0, 0
    for _ in range(149):
        actions = rule.act(env, observed)
        for slot in np.flatnonzero(observed.alive[0]):
            row = observed.observations[0, slot]
            speed, left = of(row, "speed"), of(row, "line_distance")
            straight = of(row, "turn_straight") == 1
            turn_speed = next(found for turn, found in turn_speeds.items() if of(row, f"turn_{turn}") == 1)
            target = max(15.0, turn_speed) if straight else 15.0
            if left > 0:
                target = min(15.0, math.sqrt(turn_speed**2 + 4 * left))
            since = math.atan2(of(row, "clock_sine"), of(row, "clock_cosine")) / (2 * math.pi) * 68 % 68
            to_hold = left - 60
            if 29.95 < since < 67.95 and to_hold > -10 and speed**2 <= 6 * (to_hold + 10):
                held += 1
                target = min(target, math.sqrt(4 * max(to_hold, 0.0)))
            else:
                free += 1
            expected = -3.0 if speed == target == 0 else min(max(target - speed, -3.0), 3.0)
            assert actions[0, slot, 0] == pytest.approx(expected, abs=1e-4)
        _, observed = env.step(actions)
    assert min(held, free) > 300
