"""Learning without a critic."""

from dataclasses import replace

import numpy as np
import pytest
from made_trajectories import DISCRETE, fabricate
from numpy.typing import NDArray
from toy_training import mean_return, train_toy

from headway.contracts import Trajectory
from headway_algos.on_policy.learner import OnPolicyLearner
from headway_algos.registry import configure

GAMMA = 0.9


def discounted(made: Trajectory, t: int, c: int, agent: int, ends: NDArray[np.bool_]) -> float:
    """Return the sum of an agent's discounted rewards from step t to the end of its return."""
    total = 0.0
    for later in range(t, len(made.rewards)):
        total += GAMMA ** (later - t) * float(made.rewards[later, c, agent])
        if ends[later, c, agent]:
            break
    return total


@pytest.mark.parametrize("shared_reward", [False, True])
def test_advantages_are_the_discounted_rewards_to_come(shared_reward: bool) -> None:
    """An agent's own until its stream ends; with a shared reward, the team's until the episode ends."""
    spec = replace(DISCRETE, shared_reward=shared_reward)
    made = fabricate(spec, 12, 4, seed=3, absent=0.4, idle=0.2, leaves=0.1)
    learner = OnPolicyLearner(configure("custom", critic="none", gamma=GAMMA), spec, (1,), "cpu")
    found = learner.critic.estimate(made, learner.behaviour, 1).advantages
    over = made.terminated | made.truncated
    ends = np.broadcast_to(made.episode_ended[..., None], over.shape) if shared_reward else over
    for t, c, agent in np.ndindex(*over.shape):
        expected = discounted(made, t, c, agent, ends) if made.alive[t, c, agent] else 0
        assert found[t, c, agent] == pytest.approx(expected)


@pytest.mark.slow
def test_climbing_game_is_played_at_its_safe_equilibrium() -> None:
    """7 of 11, as with critics: see `test_learning`."""
    settings = {
        "critic": "none",
        "update": "a2c",
        "policies": "independent",
        "lr": 2e-2,
        "entropy_coeff": 0.7,
    }
    assert mean_return(train_toy("matrix", {}, "custom", settings, (16, 16, 120))) == 7.0
