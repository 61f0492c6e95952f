"""Draws, ends of days, rules and errors."""

from collections.abc import Callable

import numpy as np
import pytest
from played import first_episodes, repeated

from headway.contracts import HeadwayError, RandomRule
from headway_envs.bus.scenario.source import scenario_tables
from headway_envs.bus_published.config import BusPublishedConfig, RewardConfig
from headway_envs.bus_published.entry import ENTRY
from headway_envs.bus_published.env import BusPublishedBatchedEnv
from headway_envs.bus_published.kernel.layout import MOVE, SERVICE_CENTER, WAIT
from headway_envs.bus_published.prepared import prepare
from headway_envs.bus_published.rules import MoveWithService

Begun = Callable[..., BusPublishedBatchedEnv]


def test_each_copy_draws_a_centre_and_keeps_it(begun: Begun) -> None:
    env = begun(200)
    centres = env.world.days["centre"].copy()
    assert set(centres) <= set(env.network.centres.tolist())
    assert len(set(centres)) > 0.7 * len(env.network.centres)
    while (env.world.days["number"] == 0).any():
        repeated(env, MOVE, 1)
    np.testing.assert_array_equal(env.world.days["centre"], centres)


def test_each_bus_of_a_copy_draws_a_route_by_its_trips_and_keeps_it() -> None:
    env = ENTRY.make(prepare(BusPublishedConfig(scenario="corridor", agents=2)), 1500)
    env.reset(np.arange(1500, dtype=np.uint64))
    drawn = env.world.buses["route"].copy()
    trips = scenario_tables("corridor", 0).trips.query("daytype == 'weekday'").groupby("pattern").size()
    share = trips.sort_index().to_numpy() / trips.sum()
    counts = np.bincount(drawn.ravel(), minlength=len(share))
    assert (np.abs(counts - 3_000 * share) < 5 * np.sqrt(3_000 * share)).all()
    both = (drawn[:, 0] == drawn[:, 1]).mean()
    assert both == pytest.approx((share**2).sum(), abs=0.03)  # buses draw independently
    while (env.world.days["number"] == 0).any():
        env.step(np.full((1500, 2), MOVE))
    np.testing.assert_array_equal(env.world.buses["route"], drawn)


def test_moving_beats_waiting_and_random_actions_and_service_beats_moving(begun: Begun) -> None:
    """A visit to the centre restores the uptime, which is rewarded at every move, for about one minute's
    reward. Always moving is therefore not the best, although most published learners converged to it."""
    env, team = begun(32), {}
    for name, rule in ENTRY.rules.items():
        observed = env.reset(np.arange(32, dtype=np.uint64))
        team[name] = first_episodes(env, rule.make(None), observed)["team_reward"]
    assert (team["always_move"] > team["always_wait"]).all()
    assert (team["always_move"] > team["random"]).all()
    assert (team["move_with_service"] > team["always_move"] + 100).all()
    routes = [tuple(row) for row in env.world.buses["route"].tolist()]
    by_routes = {route: set() for route in routes}
    for route, earned in zip(routes, team["always_move"].tolist(), strict=True):
        by_routes[route].add(earned)
    # Nothing but the centre and the routes is drawn, and buses that always move do not meet the centre.
    assert len(by_routes) < len(routes)
    assert all(len(earned) == 1 for earned in by_routes.values())
    assert team["always_wait"] == pytest.approx(-0.1 * 1080 * 5)


def test_metrics_count_the_actions(begun: Begun) -> None:
    env = begun(2)
    metrics = first_episodes(env, MoveWithService(None, 0.5), env.observed())
    assert (metrics["service_visits"] >= 5).all()
    assert (metrics["services_refused"] == 0).all()
    assert (metrics["moves"] + metrics["service_visits"] == 5 * metrics["steps"]).all()
    for name in ("occupancy_cost", "uptime", "regularity", "efficiency"):
        assert ((metrics[name] >= 0) & (metrics[name] <= 1)).all()
    assert (metrics["uptime"] > 0.6).all()


def test_the_rule_with_service_is_never_refused(begun: Begun) -> None:
    """Uptime falls below 0.31 when 0.64 of 100 fuel units are left, enough for short ways only."""
    env = begun(32)
    metrics = first_episodes(env, MoveWithService(None, 0.31), env.observed())
    assert (metrics["services_refused"] == 0).all()
    assert metrics["service_visits"].sum() > 0


def test_service_without_fuel_is_refused_and_an_endless_day_truncated(begun: Begun) -> None:
    """After ten hours of waiting no bus has fuel, and refused services take no time."""
    env = begun(max_steps=700)
    repeated(env, WAIT, 600)
    assert (env.world.buses["fuel"] == 0).all()
    clock = env.world.buses["clock"].copy()
    outcome = repeated(env, SERVICE_CENTER, 99)
    assert not outcome.episode_ended[0]
    np.testing.assert_array_equal(outcome.rewards, -20.0)
    np.testing.assert_array_equal(env.world.buses["clock"], clock)
    outcome = repeated(env, SERVICE_CENTER, 1)
    assert outcome.episode_ended[0]
    assert outcome.truncated.all()
    assert not outcome.terminated.any()
    assert (outcome.final_observations[..., 0] > env.observed().observations[..., 0]).all()


def test_scaled_observations_lie_within_0_and_1(begun: Begun) -> None:
    env, rule = begun(8), RandomRule()
    observed = env.observed()
    for _ in range(300):
        _, observed = env.step(rule.act(env, observed))
        assert observed.observations.min() >= 0
        assert observed.observations.max() <= 1


def test_a_shared_reward_is_the_mean(begun: Begun) -> None:
    rng, own, shared = np.random.default_rng(0), begun(3), begun(3, reward=RewardConfig(scope="team"))
    assert shared.spec.shared_reward
    for _ in range(100):
        actions = rng.integers(0, 3, (3, 5))
        paid = own.step(actions)[0].rewards.mean(axis=1)
        np.testing.assert_allclose(shared.step(actions)[0].rewards, np.tile(paid[:, None], 5), rtol=1e-5)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"scenario": "line", "centre": 9999}, "centre 9999 is none of the"),
        ({"scenario": "lime"}, "did you mean 'line'"),
    ],
)
def test_impossible_scenarios_are_one_error_line(arguments: dict[str, object], message: str) -> None:
    with pytest.raises(HeadwayError, match=message) as caught:
        prepare(BusPublishedConfig(**arguments))
    assert "\n" not in str(caught.value)


def test_wrong_shapes_are_refused(begun: Begun) -> None:
    env = begun(2)
    with pytest.raises(ValueError, match=r"actions must have shape \(2, 5\)"):
        env.step(np.zeros((2, 4), np.int64))
    with pytest.raises(ValueError, match=r"seeds must have shape \(2,\)"):
        env.reset(np.zeros(3, np.uint64))
    with pytest.raises(HeadwayError, match="copies must be at least 1, not 0"):
        ENTRY.make(env.prepared, 0)
