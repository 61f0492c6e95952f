"""Draws, ends of days, rules, ParallelEnv and errors."""

from collections.abc import Callable

import numpy as np
import pytest

from headway.contracts import HeadwayError, RandomRule, Rule
from headway_envs.bus_published.config import BusPublishedConfig, RewardConfig
from headway_envs.bus_published.entry import ENTRY
from headway_envs.bus_published.env import BusPublishedBatchedEnv
from headway_envs.bus_published.prepared import Prepared, prepare
from headway_envs.bus_published.rules import MoveWithService

Begun = Callable[..., BusPublishedBatchedEnv]


def _first_days(env: BusPublishedBatchedEnv, rule: Rule) -> dict[str, np.ndarray]:
    """Return the metrics of each copy's first day."""
    observed, first = env.observed(), np.full((env.num_copies, len(env.spec.metrics)), np.nan)
    while np.isnan(first).any():
        outcome, observed = env.step(rule.act(env, observed))
        new = outcome.episode_ended & np.isnan(first[:, 0])
        first[new] = outcome.metrics[new]
    return dict(zip(env.spec.metrics, first.T, strict=True))


def test_a_copy_does_not_depend_on_other_copies(begun: Begun, line: Prepared) -> None:
    rng = np.random.default_rng(1)
    actions = rng.integers(0, 3, (400, 5))
    many, alone = begun(4), ENTRY.make(line, 1)
    alone.reset(np.array([2], np.uint64))
    for row in actions:
        outcome, observed = many.step(np.tile(row, (4, 1)))
        rewards, seen = outcome.rewards[2].copy(), observed.observations[2].copy()
        outcome, observed = alone.step(row[None])
        np.testing.assert_array_equal(rewards, outcome.rewards[0])
        np.testing.assert_array_equal(seen, observed.observations[0])


def test_each_copy_draws_a_centre_and_keeps_it(begun: Begun) -> None:
    env = begun(200)
    centres = env.world.days["centre"].copy()
    assert set(centres) <= set(env.network.centres.tolist())
    assert len(set(centres)) > 0.7 * len(env.network.centres)
    while (env.world.days["number"] == 0).any():
        env.step(np.ones((200, 5), np.int64))
    np.testing.assert_array_equal(env.world.days["centre"], centres)


def test_moving_beats_waiting_and_random_actions_and_service_beats_moving(begun: Begun) -> None:
    """A visit to the centre restores the uptime, which is rewarded at every move, for about one minute's
    reward. Always moving is therefore not the best, although most published learners converged to it."""
    team = {
        name: _first_days(begun(32), rule.make(None))["team_reward"] for name, rule in ENTRY.rules.items()
    }
    assert (team["always_move"] > team["always_wait"]).all()
    assert (team["always_move"] > team["random"]).all()
    assert (team["move_with_service"] > team["always_move"] + 100).all()
    assert np.ptp(team["always_move"]) == 0  # nothing is drawn but the centre
    assert team["always_wait"] == pytest.approx(-0.1 * 1080 * 5)


def test_metrics_count_the_actions(begun: Begun) -> None:
    metrics = _first_days(begun(2), MoveWithService(None, 0.5))
    assert (metrics["service_visits"] >= 5).all()
    assert (metrics["services_refused"] == 0).all()
    assert (metrics["moves"] + metrics["service_visits"] == 5 * metrics["steps"]).all()
    for name in ("occupancy_cost", "uptime", "regularity", "efficiency"):
        assert ((metrics[name] >= 0) & (metrics[name] <= 1)).all()
    assert (metrics["uptime"] > 0.6).all()


def test_the_rule_with_service_is_never_refused(begun: Begun) -> None:
    """Uptime falls below 0.31 when 0.64 of 100 fuel units are left, enough for short ways only."""
    metrics = _first_days(begun(32), MoveWithService(None, 0.31))
    assert (metrics["services_refused"] == 0).all()
    assert metrics["service_visits"].sum() > 0


def test_an_endless_day_is_truncated(begun: Begun) -> None:
    env = begun(max_steps=700)
    for _ in range(600):
        env.step(np.zeros((1, 5), np.int64))
    for step in range(601, 701):
        outcome, observed = env.step(np.full((1, 5), 2))
        assert outcome.episode_ended[0] == (step == 700)
    assert outcome.truncated.all()
    assert not outcome.terminated.any()
    assert (outcome.final_observations[..., 0] > observed.observations[..., 0]).all()


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


def test_three_buses_per_route_follow_patterns_in_order(line: Prepared) -> None:
    assert len(line.lines) == 2
    assert line.groups == ("line0",) * 5
    assert line.agents == tuple(f"bus_{n}" for n in range(5))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            {"scenario": "line", "agents": 9},
            "need 3 routes, and scenario 'line' has 2: set agents_per_route higher",
        ),
        ({"scenario": "line", "centre": 9999}, "centre 9999 is none of the"),
        ({"scenario": "lime"}, "did you mean 'line'"),
    ],
)
def test_impossible_scenarios_are_one_error_line(arguments: dict[str, object], message: str) -> None:
    with pytest.raises(HeadwayError, match=message) as caught:
        prepare(BusPublishedConfig(**arguments))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"agents": 0}, "agents must be at least 1, not 0"),
        ({"agents_per_route": 0}, "agents_per_route must be at least 1"),
        ({"start_hour": 24}, "0 <= start_hour < end_hour <= 24 must hold"),
        ({"centre": -1}, "centre must be null or at least 0, not -1"),
        ({"observation": "all"}, "observation must be scaled or raw, not 'all'"),
        ({"day_type": "monday"}, "day_type must be weekday or sunday, not 'monday'"),
        ({"max_steps": 0}, "max_steps must be at least 1"),
        ({"scenario": ""}, "scenario must name line, corridor, district, city or a scenario folder"),
        ({"scenario_seed": -1}, "scenario_seed must be at least 0"),
    ],
)
def test_impossible_arguments_are_named(arguments: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        BusPublishedConfig(**arguments)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"uptime": -1.0}, "uptime must be at least 0, not -1"),
        ({"occupancy": 0, "uptime": 0, "regularity": 0, "efficiency": 0}, "at least one of the weights"),
        ({"low_occupancy": 0.95}, "0 < low_occupancy < high_occupancy < 1 must hold"),
        ({"target_headway_s": 0}, "target_headway_s must be above 0, not 0"),
    ],
)
def test_impossible_rewards_are_named(arguments: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        RewardConfig(**arguments)


def test_the_rule_with_service_refuses_other_environments() -> None:
    with pytest.raises(TypeError, match="move_with_service needs a BusPublishedBatchedEnv, not object"):
        MoveWithService(None, 0.5).act(object(), None)


def test_wrong_shapes_are_refused(begun: Begun) -> None:
    env = begun(2)
    with pytest.raises(ValueError, match=r"actions must have shape \(2, 5\)"):
        env.step(np.zeros((2, 4), np.int64))
    with pytest.raises(ValueError, match=r"seeds must have shape \(2,\)"):
        env.reset(np.zeros(3, np.uint64))
    with pytest.raises(HeadwayError, match="copies must be at least 1, not 0"):
        ENTRY.make(env.prepared, 0)
