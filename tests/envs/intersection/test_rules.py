"""Rules act within bounds, and those that heed the right of way do not crash."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from headway.contracts import Rule
from headway_envs.intersection.entry import ENTRY
from headway_envs.intersection.env import IntersectionBatchedEnv
from headway_envs.intersection.rules import Reservation
from headway_envs.intersection.simulation import libsumo


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
def test_every_rule_plays(name: str, crossing: Callable[..., Any]) -> None:
    env = crossing(horizon=300)
    metrics = _played(env, ENTRY.rules[name](env.prepared), 1)
    assert all(np.isfinite(list(metrics.values())))
    assert metrics["avs"] > 5


def test_humans_heed_the_right_of_way_and_full_throttle_does_not(crossing: Callable[..., Any]) -> None:
    env = crossing(horizon=1200)
    crashes = {}
    for name in ("human", "reservation", "full_throttle"):
        env.close()
        env = crossing(horizon=1200)
        rule = ENTRY.rules[name](env.prepared)
        crashes[name] = [_played(env, rule, seed)["collisions"] for seed in (1, 2)]
    assert sum(crashes["human"]) == 0
    assert sum(crashes["full_throttle"]) >= 2
    assert sum(crashes["reservation"]) < sum(crashes["full_throttle"])


def test_handed_over_vehicles_are_humans_to_sumo(crossing: Callable[..., Any]) -> None:
    env, sumo = crossing(horizon=600), libsumo()
    rule, observed = ENTRY.rules["human"](env.prepared), env.reset(np.array([1], np.uint64))
    for step in range(300):
        actions = rule.act(env, observed) if step >= 150 else np.zeros((1, 96, 1), np.float32)
        _, observed = env.step(actions)
    assert observed.alive.any()
    for vehicle in env.street.roster.ids:
        assert sumo.vehicle.getTypeID(vehicle) == "hdv"
        assert sumo.vehicle.getSpeedMode(vehicle) == 31


def test_who_asked_first_goes_first(crossing: Callable[..., Any]) -> None:
    """Two automated vehicles on crossing ways never are inside the junction at once."""
    env, rule = crossing(vph_per_lane_hdv=0, horizon=1200), Reservation()
    observed, foes = env.reset(np.array([2], np.uint64)), env.prepared.network.foes
    inside_at_once = crossed = 0
    for _ in range(1199):
        _, observed = env.step(rule.act(env, observed))
        traffic, count = env.street.roster.traffic, len(env.street.roster)
        link, position = traffic.link[:count], traffic.position[:count]
        rows = np.flatnonzero((position > 201) & (position < 200 + env.prepared.network.link_length[link]))
        crossed += len(rows)
        inside_at_once += foes[np.ix_(link[rows], link[rows])].sum()
    assert crossed > 200
    assert inside_at_once == 0
    assert env.ledger.crashes == 0
