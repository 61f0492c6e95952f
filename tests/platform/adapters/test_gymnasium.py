"""Gymnasium environments as batches with one agent."""

import gymnasium
import numpy as np

from headway.adapters.gymnasium import GymnasiumBatch
from headway.adapters.pettingzoo import episode_seed
from headway.contracts import Box, Discrete

SEEDS = np.array([3, 4], dtype=np.uint64)


def test_steps_equal_those_of_the_environment() -> None:
    env = GymnasiumBatch(lambda: gymnasium.make("CartPole-v1"), 2, "CartPole-v1")
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
    env = GymnasiumBatch(lambda: gymnasium.make("Pendulum-v1", max_episode_steps=3), 2, "Pendulum-v1")
    assert env.spec.action_space == Box((-2.0,), (2.0,))
    env.reset(SEEDS)
    for step in range(1, 4):
        outcome, observed = env.step(np.full((2, 1, 1), 99, dtype=np.float32))
        assert outcome.truncated.all() == (step == 3)
    assert not outcome.terminated.any()
    assert observed.alive.all()
    assert not np.array_equal(outcome.final_observations, observed.observations)
