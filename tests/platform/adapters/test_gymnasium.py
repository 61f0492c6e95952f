"""Gymnasium environments as batches with one agent."""

import gymnasium
import numpy as np
import pytest

from headway.adapters.modules import module_entry
from headway.adapters.pettingzoo import episode_seed
from headway.config.schema import build, describe
from headway.contracts import BatchedEnv, Box, Discrete, HeadwayError

SEEDS = np.array([3, 4], dtype=np.uint64)


def two_copies(env_id: str, **arguments: object) -> BatchedEnv:
    entry = module_entry(env_id, arguments=arguments)
    return entry.make(entry.prepare(build(entry.config, arguments, "env.args", env_id)), 2)


def test_steps_equal_those_of_the_environment() -> None:
    env = two_copies("gymnasium:CartPole-v1")
    assert env.spec.agents == ("agent",)
    assert env.spec.action_space == Discrete(2)
    assert env.spec.state_size == 0
    alone = gymnasium.make("CartPole-v1")
    observed = env.reset(SEEDS)
    expected, _ = alone.reset(seed=episode_seed(4, 0))
    np.testing.assert_array_equal(observed.observations[1, 0], expected)
    terminated = False
    while not terminated:
        outcome, observed = env.step(np.ones((2, 1), dtype=np.int64))
        expected, reward, terminated, _, _ = alone.step(1)
        assert outcome.rewards[1, 0] == reward
        assert outcome.terminated[1, 0] == outcome.episode_ended[1] == terminated
    np.testing.assert_array_equal(outcome.final_observations[1, 0], expected)
    expected, _ = alone.reset(seed=episode_seed(4, 1))
    np.testing.assert_array_equal(observed.observations[1, 0], expected)


def test_a_time_limit_truncates() -> None:
    gymnasium.register("Brief-v0", "gymnasium.envs.classic_control.pendulum:PendulumEnv", max_episode_steps=3)
    env = two_copies("gymnasium:Brief-v0")
    assert env.spec.action_space == Box((-2.0,), (2.0,))
    env.reset(SEEDS)
    for step in range(1, 4):
        outcome, observed = env.step(np.full((2, 1, 1), 99, dtype=np.float32))
        assert outcome.truncated.all() == (step == 3)
    assert not outcome.terminated.any()
    assert observed.alive.all()
    assert not np.array_equal(outcome.final_observations, observed.observations)


def test_arguments_are_those_of_the_class() -> None:
    defaults = {row.key: row.default for row in describe(module_entry("gymnasium:Pendulum-v1").config)}
    assert defaults == {"render_mode": "null", "g": "10.0"}
    light, heavy = two_copies("gymnasium:Pendulum-v1", g=1.0), two_copies("gymnasium:Pendulum-v1")
    push = np.zeros((2, 1, 1), dtype=np.float32)
    for env in (light, heavy):
        env.reset(SEEDS)
    assert (light.step(push)[1].observations != heavy.step(push)[1].observations).any()


@pytest.mark.parametrize(
    ("env_id", "message"),
    [
        ("gymnasium:CartPoe-v1", "env.id=gymnasium:CartPoe-v1 cannot be used: NameNotFound.*Did you mean"),
        ("gymnasium:", "cannot be used: Error: Malformed environment ID"),
        (":CartPole-v1", "is not MODULE:ID, such as gymnasium:CartPole-v1"),
        ("pettingzo:sisl/pursuit-v5", "no package pettingzo; did you mean env=pettingzoo:sisl/pursuit-v5"),
        ("sisl.pursuit_v5", "no package sisl; did you mean env=pettingzoo.sisl.pursuit_v5"),
        ("nolib:X-v0", "there is no package nolib; install it"),
        ("os:X-v0", "os is not an installed package that depends on Gymnasium or PettingZoo, and"),
    ],
)
def test_unusable_ids_are_one_line_errors(env_id: str, message: str) -> None:
    with pytest.raises(HeadwayError, match=message):
        module_entry(env_id)
