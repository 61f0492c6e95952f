"""Observations of platoons: cases by hand, and all traffic beside a naive loop over routes."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from headway_envs.junctions.env import JunctionsBatchedEnv
from headway_envs.junctions.files import FOUR_WAY_FILE
from headway_envs.junctions.network import Network
from headway_envs.platoons import observe

Open = Callable[..., Any]
FAR, GONE = (1.0, -1.0), (-1.0, 1.0)
"""Distance and speed of a head or end that does not exist, and of the end of a platoon that is not there."""


def _seen(
    vehicles: Sequence[tuple[int, float, float, bool]], row: int
) -> dict[str, list[tuple[float, float]]]:
    """Return the (distance, speed) pairs that an AV in `row` of (approach, distance, speed, automated)
    observes: its own and its platoon's end, then three for each other approach, clockwise."""
    approach, distance, speed, automated = (np.array(column) for column in zip(*vehicles, strict=True))
    slot = np.where(automated, np.arange(len(vehicles)), -1)
    observations, alive = np.full((len(vehicles), 22), 9, np.float32), np.ones(len(vehicles), np.bool_)
    network = Network.read(FOUR_WAY_FILE)
    observe(
        np.lexsort((distance, approach)), approach, distance, speed, slot, network.others, 100.0, 13.0,
        11, np.zeros(len(vehicles), np.int64), np.zeros(4, np.int64), observations, alive,
    )  # fmt: skip
    assert alive.tolist() == automated.tolist()
    assert (observations[~alive] == 0).all()
    found = observations[row].reshape(2, 11).T
    pairs = [(round(float(near), 4), round(float(quick), 4)) for near, quick in found]
    return {"own": pairs[:2], "1": pairs[2:5], "2": pairs[5:8], "3": pairs[8:]}


def test_an_av_alone_sees_itself_as_the_end_of_its_platoon() -> None:
    seen = _seen([(0, 25.0, 6.5, True)], 0)
    assert seen["own"] == [(-0.5, 0.0)] * 2
    assert seen["1"] == seen["2"] == seen["3"] == [GONE, FAR, FAR]


def test_an_av_with_followers_is_head_of_a_platoon() -> None:
    """West sees south's AV and its second follower; the next AV begins another platoon."""
    south = [(2, 10.0, 13.0, True), (2, 20.0, 13.0, False), (2, 30.0, 6.5, False), (2, 50.0, 0.0, True)]
    seen = _seen([(3, 75.0, 0.0, True), *south], 0)
    assert seen["own"] == [(0.5, -1.0)] * 2
    assert seen["1"] == seen["2"] == [GONE, FAR, FAR]  # north and east
    assert seen["3"] == [GONE, (-0.8, 1.0), (-0.4, 0.0)]
    assert _seen([(3, 75.0, 0.0, True), *south], 1)["own"] == [(-0.8, 1.0), (-0.4, 0.0)]


def test_human_drivers_first_are_the_rest_of_a_platoon_that_is_crossing() -> None:
    east = [(1, -8.0, 13.0, True), (1, 5.0, 13.0, False), (1, 15.0, 13.0, False), (1, 60.0, 6.5, True)]
    seen = _seen([(0, 25.0, 6.5, True), *east, (1, 80.0, 0.0, False)], 0)
    assert seen["1"] == [(-0.7, 1.0), (0.2, 0.0), (0.6, -1.0)]
    humans = _seen([(0, 25.0, 6.5, True), (1, 5.0, 13.0, False)], 0)
    assert humans["1"] == [(-0.9, 1.0), FAR, FAR]


def test_a_vehicle_past_the_line_is_not_seen_and_sees_no_one() -> None:
    """The end of its platoon still shows its speed."""
    traffic = [(0, -3.0, 13.0, True), (0, 12.0, 6.5, False), (1, 30.0, 6.5, True)]
    assert _seen(traffic, 2)["3"] == [(-0.76, 0.0), FAR, FAR]  # the human driver
    assert _seen([traffic[0], traffic[2]], 1)["3"] == [GONE, FAR, FAR]
    past = _seen(traffic, 0)
    assert past == {"own": [(1.0, 1.0), (1.0, 0.0)], **{other: [GONE, FAR, FAR] for other in "123"}}


def _naive(env: JunctionsBatchedEnv) -> NDArray[np.float32]:
    """Return the observations of all slots by the study's definition, from SUMO's lanes and positions."""
    order, found = ("north", "east", "south", "west"), np.zeros((96, 22), np.float32)
    sumo, routes = (
        env.traffic.simulation.sumo.vehicle,
        {name: [] for name in ("north", "east", "south", "west")},
    )
    for name, vehicle in env.traffic.vehicles.items():
        lane, place = sumo.getLaneID(name), sumo.getLanePosition(name)
        place += 100 if lane.startswith(":") else 114.4 if "_out" in lane else 0
        routes[sumo.getRouteID(name)].append((place, sumo.getSpeed(name), vehicle.slot))
    platoons: dict[str, list[list[tuple[float, float, int]]]] = {}
    for route, queue in routes.items():
        platoons[route] = [[]]
        for vehicle in sorted(queue, reverse=True):
            if vehicle[2] >= 0:
                platoons[route].append([])
            platoons[route][-1].append(vehicle)
    for route in order:
        for platoon in platoons[route]:
            if not platoon or platoon[0][2] < 0:
                continue
            past, shown = platoon[0][0] > 100, [platoon[0], platoon[-1]]
            pairs = [(1.0 if past else (100 - place) / 100, speed / 13) for place, speed, _ in shown]
            for turn in range(1, 4):
                rows = [(0.0, 1.0), (1.0, 0.0), (1.0, 0.0)]
                other = platoons[order[(order.index(route) + turn) % 4]]
                waiting = [
                    (number, each) for number, row in enumerate(other) for each in row if each[0] <= 100
                ]
                if waiting and not past:
                    number, first = waiting[0]
                    if first[2] < 0:
                        rows[0] = ((100 - other[number][-1][0]) / 100, other[number][-1][1] / 13)
                        number += 1
                    if number < len(other):
                        rows[1:] = [
                            ((100 - v[0]) / 100, v[1] / 13) for v in (other[number][0], other[number][-1])
                        ]
                pairs += rows
            found[platoon[0][2]] = 2 * np.clip(np.array(pairs).T.ravel(), 0, 1) - 1
    return found


@pytest.mark.parametrize("share", [0.1, 0.333, 1.0])
def test_observations_equal_a_naive_loop_over_routes(share: float, junctions: Open) -> None:
    env, draw, seen = junctions(automated_share=share), np.random.default_rng(1), 0
    env.reset(np.array([3], np.uint64))
    for _ in range(400):
        _, observed = env.step(draw.choice(3, (1, 96), p=(0.2, 0.4, 0.4)))
        expected = _naive(env)
        np.testing.assert_allclose(observed.observations[0], expected, rtol=0, atol=2e-6)
        seen += observed.alive.sum()
    assert seen > 300
