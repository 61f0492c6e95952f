"""What an agent that died leaves behind: nothing to value, whatever it observed and did before."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from headway.contracts import Discrete, EnvSpec, Trajectory, TrajectoryLayout
from headway_algos.config import AlgoConfig, ModelConfig
from headway_algos.on_policy.critics.estimate import CriticEstimate
from headway_algos.on_policy.learner import OnPolicyLearner
from headway_algos.recipes.coma import COMAConfig
from headway_algos.recipes.mappo import MAPPOConfig

LIMIT, DEATH, GAMMA = 20, 3, 0.95
BLIND = EnvSpec("mortal", ("a", "b"), 1, Discrete(2), shared_reward=True, agents_come_and_go=True)
STATE = replace(BLIND, state_size=1)
SETTINGS: dict[str, Any] = {"model": ModelConfig((32,)), "gamma": GAMMA, "lr": 5e-3, "lr_end": 0.05}
MAPPO = MAPPOConfig(**SETTINGS)
OTHERS, COMA = replace(MAPPO, critic_actions="others"), COMAConfig(**SETTINGS)
CASES: dict[str, tuple[AlgoConfig, EnvSpec]] = {
    "mappo": (MAPPO, BLIND),
    "others": (OTHERS, BLIND),
    "others, state": (OTHERS, STATE),
    "coma": (COMA, BLIND),
    "coma, state": (COMA, STATE),
}
every_case = pytest.mark.parametrize(("config", "spec"), CASES.values(), ids=CASES)


def _mortal(spec: EnvSpec, seed: int) -> Trajectory:
    """Four whole episodes of LIMIT steps side by side. The team is paid 1 per step until b dies at the end of
    step DEATH; a goes on alone until the time limit. Observations and state are the time until the death."""
    made = Trajectory.allocate(TrajectoryLayout(spec, LIMIT, 4))
    time = np.arange(LIMIT + 1) % LIMIT
    lives = time < DEATH
    made.observations[:] = np.minimum(time, DEATH)[:, None, None, None]
    made.observations[~lives, :, 1] = np.nan
    made.states[:] = np.where(lives, time, DEATH)[:, None, None]
    made.alive[:, :, 0], made.alive[:, :, 1] = True, lives[:, None]
    made.acting[:] = made.alive[:-1]
    made.rewards[:] = lives[:-1, None, None]
    made.actions[:] = np.random.default_rng(seed).integers(2, size=made.actions.shape)
    made.log_probs[:] = np.log(0.5)
    made.truncated[-1, :, 0] = True
    made.terminated[[DEATH - 1, LIMIT - 1], :, 1] = True
    made.final_observations[:] = DEATH
    made.final_observations[:, :, 1] = DEATH - 1
    made.final_states[:] = DEATH
    return made


def _estimate(learner: OnPolicyLearner, made: Trajectory) -> CriticEstimate:
    return learner.critic.estimate(made, learner.behaviour, 1)


@every_case
def test_after_the_death_that_ends_all_pay_the_value_comes_to_be_0(config: AlgoConfig, spec: EnvSpec) -> None:
    """And before it, from every agent's view, what is still paid: (1 - gamma^k) / (1 - gamma)."""
    learner, iterations = OnPolicyLearner(config, spec, (1,), "cpu"), 100
    for iteration in range(1, iterations + 1):
        learner.update(_mortal(spec, iteration), iteration, iteration / iterations)
    estimate = _estimate(learner, _mortal(spec, 0))
    np.testing.assert_allclose(estimate.values[DEATH:, :, 0], 0, atol=0.1)
    paid = (1 - GAMMA ** np.arange(DEATH, 0, -1)) / (1 - GAMMA)
    for viewpoint in range(estimate.returns.shape[2]):
        returns = estimate.returns[:DEATH, :, viewpoint]
        np.testing.assert_allclose(returns, np.repeat(paid[:, None], 4, axis=1), atol=0.15)


@every_case
@pytest.mark.parametrize("shared_reward", [True, False])
def test_what_an_agent_observed_before_it_died_is_forgotten_at_the_time_limit(
    config: AlgoConfig, spec: EnvSpec, shared_reward: bool
) -> None:
    learner = OnPolicyLearner(config, replace(spec, shared_reward=shared_reward), (1,), "cpu")
    made = _mortal(spec, 0)
    before = _estimate(learner, made)
    made.final_observations[-1, :, 1] += 5
    after = _estimate(learner, made)
    np.testing.assert_array_equal(after.returns, before.returns)
    np.testing.assert_array_equal(after.advantages, before.advantages)


@pytest.mark.parametrize("config", [MAPPO, OTHERS, COMA])
def test_what_an_agent_observes_as_it_is_cut_counts_for_its_team(config: AlgoConfig) -> None:
    """b lives until the time limit cuts it, too: without a state, its observation is part of it."""
    learner = OnPolicyLearner(config, BLIND, (1,), "cpu")
    made = _mortal(BLIND, 0)
    made.alive[:, :, 1], made.observations[:, :, 1] = True, 1
    made.terminated[:], made.truncated[-1] = False, True
    before = _estimate(learner, made)
    made.final_observations[-1, :, 1] += 5
    assert (_estimate(learner, made).returns[-1, :, 0] != before.returns[-1, :, 0]).all()


@pytest.mark.parametrize("config", [MAPPO, OTHERS, COMA])
def test_an_agent_away_at_the_cut_awaits_what_its_own_last_observation_is_worth(config: AlgoConfig) -> None:
    """With a reward of its own; the other agent, which does not see it, awaits the same as before."""
    spec = replace(BLIND, shared_reward=False)
    learner = OnPolicyLearner(config, spec, (1,), "cpu")
    made = _mortal(spec, 0)
    made.terminated[:] = False
    made.truncated[-1] = True
    before = _estimate(learner, made).returns
    made.final_observations[-1, :, 1] += 5
    after = _estimate(learner, made).returns
    assert (after[DEATH - 1, :, 1] != before[DEATH - 1, :, 1]).all()
    np.testing.assert_array_equal(after[..., 0], before[..., 0])
