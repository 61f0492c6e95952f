"""Returns of agents that die, leave or are away, where what the others are paid does not depend on it."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from covering import pairwise, quick_or_slow
from made_trajectories import end_episodes

from headway.contracts import Discrete, EnvSpec, Trajectory, TrajectoryLayout
from headway_algos.batches.critic_batch import CriticBatch
from headway_algos.config import AlgoConfig, ModelConfig
from headway_algos.on_policy.critics.counterfactual import CounterfactualCritic
from headway_algos.on_policy.critics.estimate import CriticEstimate
from headway_algos.on_policy.critics.value import ValueCritic
from headway_algos.on_policy.learner import OnPolicyLearner
from headway_algos.registry import configure

LIMIT, DEATH, GAMMA = 20, 3, 0.95
BLIND = EnvSpec("mortal", ("a", "b"), 1, Discrete(2), shared_reward=True, agents_come_and_go=True)
STATE = replace(BLIND, state_size=1)
SETTINGS: dict[str, Any] = {"model": ModelConfig((32,)), "gamma": GAMMA, "lr": 5e-3, "lr_end": 0.05}
MAPPO = configure("mappo", **SETTINGS)
IPPO = configure("ippo", **SETTINGS)
OTHERS, COMA = replace(MAPPO, critic_actions="others"), configure("coma", **SETTINGS)
CASES: dict[str, tuple[AlgoConfig, EnvSpec]] = {
    "mappo": (MAPPO, BLIND), "others": (OTHERS, BLIND), "others, state": (OTHERS, STATE),
    "coma": (COMA, BLIND), "coma, state": (COMA, STATE),
}  # fmt: skip
every_case = pytest.mark.parametrize(("config", "spec"), quick_or_slow(CASES, "others, state"))


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
    end_episodes(made)
    return made


def _estimate(learner: OnPolicyLearner, made: Trajectory) -> CriticEstimate:
    return learner.critic.estimate(made, learner.behaviour, 1)


@every_case
def test_the_value_is_0_after_the_death_that_ends_all_rewards(config: AlgoConfig, spec: EnvSpec) -> None:
    """Before the death, the value is what will still be paid, (1 - gamma^k) / (1 - gamma), from every agent's
    view."""
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
def test_an_agent_absent_at_the_cut_bootstraps_from_its_last_observation(config: AlgoConfig) -> None:
    """The agent has an individual reward; the target of the other agent, which does not observe it, is
    unchanged."""
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


PAY = -1.0
FOREVER = PAY / (1 - GAMMA)
THREE = EnvSpec(
    "left", tuple("abc"), 1, Discrete(2), groups=tuple("xxx"), shared_reward=True, agents_come_and_go=True
)
IN_GROUPS = replace(THREE, shared_reward=False, shared_in_groups=True)
INDIVIDUAL = replace(THREE, shared_reward=False)
LEAVE = 1
"""Action by which a and b leave for the rest of the episode."""


def _left(
    spec: EnvSpec, seed: int, steps: int, chance: float = 0.3, limit: int | None = None, copies: int = 8
) -> Trajectory:
    """The team is paid PAY per step whatever happens; a and b leave by choice, c stays.

    The episode lasts beyond the trajectory, or is cut every `limit` steps.
    """
    draw = np.random.default_rng(seed)
    made = Trajectory.allocate(TrajectoryLayout(spec, steps, copies))
    made.rewards[:], made.log_probs[:] = PAY, np.log(0.5)
    made.actions[:] = draw.random(made.actions.shape) < chance
    here = np.ones((copies, 3), np.bool_)
    for t in range(steps):
        made.alive[t] = made.acting[t] = here
        leaves = here & (made.actions[t] == LEAVE) & [True, True, False]
        made.terminated[t], here = leaves, here & ~leaves
        if limit is not None and (t + 1) % limit == 0:
            made.truncated[t], made.terminated[t] = here, ~here
            here = np.ones_like(here)
    made.alive[-1] = here
    end_episodes(made)
    return made


def _away(spec: EnvSpec, seed: int, steps: int) -> Trajectory:
    """The team is paid PAY per step; no agent leaves, but each is away at 6 steps in 10, at random.

    The episode lasts beyond the trajectory.
    """
    made = _left(spec, seed, steps, chance=0)
    made.alive[:] = np.random.default_rng(seed).random(made.alive.shape) < 0.4
    made.alive[-1, 0] = False
    made.acting[:] = made.alive[:-1]
    return made


def _with_constant_critic(config: AlgoConfig, spec: EnvSpec, value: float) -> OnPolicyLearner:
    learner = OnPolicyLearner(replace(config, normalise_values=False), spec, (1,), "cpu")
    critic = learner.critic
    assert isinstance(critic, CounterfactualCritic | ValueCritic)
    both = [critic.networks, critic.target] if isinstance(critic, CounterfactualCritic) else [critic.networks]
    for networks in both:
        networks.network.weights[-1].data.zero_()
        networks.network.biases[-1].data.fill_(value)
    return learner


@pytest.mark.parametrize(
    ("config", "spec", "limit", "steps"),
    pairwise([IPPO, MAPPO, OTHERS, COMA], [THREE, IN_GROUPS], [None, 8], [3, 32]),
)
def test_leaving_without_effect_has_no_advantage(
    config: AlgoConfig, spec: EnvSpec, limit: int | None, steps: int
) -> None:
    """If V is the true value of a constant reward for ever, it equals the return of every action, for
    rollouts of any length."""
    learner = _with_constant_critic(config, spec, FOREVER)
    made = _left(spec, 0, steps, limit=limit)
    assert made.terminated[:, :, :2].any()
    estimate = _estimate(learner, made)
    np.testing.assert_allclose(estimate.returns[estimate.present], FOREVER, rtol=1e-6)
    np.testing.assert_allclose(estimate.advantages[estimate.present], 0, atol=1e-5)


@pytest.mark.parametrize(
    ("config", "spec", "steps"), pairwise([IPPO, MAPPO, OTHERS, COMA], [INDIVIDUAL, THREE], [3, 32])
)
def test_an_agent_away_as_the_rollout_ends_awaits_as_much_as_when_last_seen(
    config: AlgoConfig, spec: EnvSpec, steps: int
) -> None:
    """A pay without end is worth the same at any length of rollouts."""
    learner = _with_constant_critic(config, spec, FOREVER)
    made = _away(spec, 0, steps)
    estimate = _estimate(learner, made)
    np.testing.assert_allclose(estimate.returns[estimate.present], FOREVER, rtol=1e-6)


@pytest.mark.parametrize("config", [IPPO, OTHERS, COMA], ids=["ippo", "others", "coma"])
def test_the_return_of_an_agent_that_left_includes_later_rewards_of_its_team(config: AlgoConfig) -> None:
    """The episode terminates after LIMIT steps: (1 - gamma^k) / (1 - gamma) of PAY from k steps before."""
    learner = OnPolicyLearner(replace(config, gae_lambda=1.0), THREE, (1,), "cpu")
    made = _left(THREE, 0, LIMIT, chance=0.1)
    made.terminated[-1] = made.episode_ended[-1] = True
    estimate = _estimate(learner, made)
    expected = PAY * (1 - GAMMA ** np.arange(LIMIT, 0, -1)) / (1 - GAMMA)
    for step in range(LIMIT):
        np.testing.assert_allclose(estimate.returns[step][estimate.present[step]], expected[step], rtol=1e-9)


def test_ippo_does_not_learn_to_leave_where_it_changes_nothing() -> None:
    """If its return ended as it leaves, this would be the way out of a negative pay."""
    config = replace(IPPO, lr=1e-2, lr_end=1.0, policies="shared", gae_lambda=1.0)
    learner, chance = OnPolicyLearner(config, THREE, (1,), "cpu"), 0.5
    for iteration in range(1, 31):
        made = _left(THREE, iteration, 40, chance, limit=8)
        made.log_probs[:] = np.log(np.where(made.actions == LEAVE, chance, 1 - chance))
        learner.update(made, iteration, 0.0)
        chance = float(learner.behaviour.probabilities(CriticBatch.of_steps(made))[0, 0, 0, LEAVE])
    assert 0.3 < chance < 0.7


def test_the_last_agent_to_leave_does_not_end_the_episode() -> None:
    """The team is paid on, also where the learner leaves out slots that were never alive."""
    spec = replace(THREE, agents=tuple("abcde"), groups=())
    learner = OnPolicyLearner(replace(IPPO, policies="shared", gae_lambda=1.0), spec, (1,), "cpu")
    made = Trajectory.allocate(TrajectoryLayout(spec, LIMIT, 2))
    made.rewards[:], made.alive[: DEATH + 1, :, 0] = PAY, True
    made.acting[:] = made.alive[:-1]
    made.terminated[DEATH, :, 0] = made.terminated[-1] = made.episode_ended[-1] = True
    estimate = _estimate(learner, learner._drop_unused_slots(made))
    expected = PAY * (1 - GAMMA ** np.arange(LIMIT, 0, -1)) / (1 - GAMMA)
    np.testing.assert_allclose(estimate.returns[: DEATH + 1, 0, 0], expected[: DEATH + 1], rtol=1e-9)


@pytest.mark.parametrize("config", [IPPO, MAPPO, OTHERS, COMA], ids=["ippo", "mappo", "others", "coma"])
@pytest.mark.parametrize("flag", ["terminated", "truncated"])
def test_the_ends_of_all_streams_at_once_do_not_end_the_episode(config: AlgoConfig, flag: str) -> None:
    """All slots are freed at step DEATH, as happens if there are few, and the team's rewards continue."""
    spec = replace(THREE, agents=("a", "b"), groups=(), state_size=1)
    learner = OnPolicyLearner(replace(config, gae_lambda=1.0), spec, (1,), "cpu")
    made = Trajectory.allocate(TrajectoryLayout(spec, LIMIT, 2))
    made.rewards[:], made.alive[: DEATH + 1] = PAY, True
    made.acting[:] = made.alive[:-1]
    getattr(made, flag)[DEATH] = made.terminated[-1] = made.episode_ended[-1] = True
    made.final_states[:-1] = np.nan  # valid where the episode ends
    estimate = _estimate(learner, made)
    expected = PAY * (1 - GAMMA ** np.arange(LIMIT, 0, -1)) / (1 - GAMMA)
    np.testing.assert_allclose(estimate.returns[: DEATH + 1, 0, 0], expected[: DEATH + 1], rtol=1e-9)


def test_a_stream_cut_with_all_others_bootstraps_from_the_state_that_follows() -> None:
    """With individual rewards; the final state is valid only where the episode ends."""
    spec = replace(INDIVIDUAL, agents=("a", "b"), groups=(), state_size=1)
    learner = OnPolicyLearner(MAPPO, spec, (1,), "cpu")
    made = Trajectory.allocate(TrajectoryLayout(spec, LIMIT, 2))
    made.alive[:] = made.acting[:] = made.truncated[DEATH] = True
    made.final_states[:] = np.nan
    before = _estimate(learner, made).returns
    assert np.isfinite(before).all()
    made.states[DEATH + 1] += 5
    assert (_estimate(learner, made).returns[DEATH] != before[DEATH]).all()
