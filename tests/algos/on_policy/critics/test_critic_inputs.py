"""Inputs of critics per viewpoint, and sampled actions where none were taken."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from made_trajectories import DISCRETE, STATE, TEAM, fabricate, poisoned
from numpy.typing import NDArray

from headway.contracts import Box, EnvSpec, MultiDiscrete, Trajectory, generator
from headway_algos.batches.critic_batch import CriticBatch
from headway_algos.config import AlgoConfig, ModelConfig
from headway_algos.on_policy.critics.counterfactual import CounterfactualCritic
from headway_algos.on_policy.critics.estimate import CriticEstimate
from headway_algos.on_policy.critics.value import ValueCritic
from headway_algos.on_policy.learner import OnPolicyLearner
from headway_algos.registry import configure

TEAM_BLIND = replace(DISCRETE, shared_reward=True)
BOX = replace(STATE, action_space=Box((-0.5, -1.0), (0.5, 1.0)), has_action_mask=False)
SETTINGS: dict[str, Any] = {"model": ModelConfig(hidden=(7, 6), actor_gain=0.5), "precision": "float64"}
COMA = configure("coma", **SETTINGS)
OTHERS = configure("mappo", **SETTINGS, critic_actions="others")
STEPS = 9


def _estimate(learner: OnPolicyLearner, made: Trajectory) -> CriticEstimate:
    return learner.critic.estimate(made, learner.behaviour, 1)


def _inputs(learner: OnPolicyLearner, made: Trajectory) -> NDArray[np.float64]:
    """(T, C, N, input_size)"""
    critic = learner.critic
    assert isinstance(critic, CounterfactualCritic | ValueCritic)
    return critic.layout.by_agent(_estimate(learner, made).inputs, len(made.rewards))


@pytest.mark.parametrize("config", [COMA, OTHERS])
@pytest.mark.parametrize("spec", [DISCRETE, TEAM])
def test_a_viewpoint_shows_the_others_actions_and_not_its_own(config: AlgoConfig, spec: EnvSpec) -> None:
    learner = OnPolicyLearner(config, spec, (1,), "cpu")
    made = fabricate(spec, 5, 2, seed=0, absent=0.3)
    made.actions[:, :, 1] = 0
    before = _inputs(learner, made)
    made.actions[:, :, 1] = 2
    changed = (before != _inputs(learner, made)).any(axis=-1)
    there = made.alive[:-1, :, 1]
    assert not changed[:, :, 1].any()
    for n in (0, 2, 3):
        np.testing.assert_array_equal(changed[:, :, n], there)


def test_each_of_the_others_choices_is_one_hot() -> None:
    spec = replace(DISCRETE, action_space=MultiDiscrete((2, 3)), has_action_mask=False)
    learner = OnPolicyLearner(OTHERS, spec, (1,), "cpu")
    made = fabricate(spec, 5, 2, seed=0)
    made.actions[:] = np.random.default_rng(0).integers(0, (2, 3), made.actions.shape)
    inputs = _inputs(learner, made)
    shown = inputs[..., -5 * spec.num_agents :].reshape(*inputs.shape[:3], spec.num_agents, 5)
    for step, copy, agent, other in np.ndindex(*shown.shape[:4]):
        expected = np.zeros(5)
        if other != agent:
            first, second = made.actions[step, copy, other]
            expected[[first, 2 + second]] = 1
        np.testing.assert_array_equal(shown[step, copy, agent, other], expected)


@pytest.mark.parametrize("config", [COMA, replace(OTHERS, policies="shared")])
@pytest.mark.parametrize("spec", [STATE, TEAM_BLIND])
def test_features_are_normalised_and_indicators_are_not(config: AlgoConfig, spec: EnvSpec) -> None:
    learner = OnPolicyLearner(config, spec, (1,), "cpu")
    critic = learner.critic
    assert isinstance(critic, CounterfactualCritic | ValueCritic)
    made = poisoned(fabricate(spec, STEPS, 3, seed=0, absent=0.3))
    raw = _estimate(learner, made).inputs[0]
    critic.update_normalisers(made)
    scaled = _estimate(learner, made).inputs[0]
    here = torch.from_numpy(critic.layout.selection(made.alive[:-1])[0])
    size, (rows, own_rows) = critic.critic_inputs.feature_size, (scaled[here], raw[here])
    mean, std = own_rows[:, :size].mean(0), own_rows[:, :size].std(0, correction=0)
    torch.testing.assert_close(rows[:, :size], (own_rows[:, :size] - mean) / std, rtol=1e-6, atol=1e-6)
    assert torch.equal(rows[:, size:], own_rows[:, size:])
    assert rows.shape[1] == size + 4 * 3 + (4 if config is COMA else 0)


def test_a_team_of_one_has_no_value_while_its_agent_is_absent() -> None:
    """There is no Q without an action, although the team's return continues."""
    spec = replace(TEAM, agents=("a",), groups=("x",))
    made = fabricate(spec, 6, 2, seed=0, absent=0.4)
    for config in (COMA, OTHERS):
        estimate = _estimate(OnPolicyLearner(config, spec, (1,), "cpu"), made)
        np.testing.assert_array_equal(estimate.present, made.alive[:-1])
        assert (estimate.advantages[~made.alive[:-1]] == 0).all()


@pytest.mark.parametrize("spec", [STATE, BOX])
def test_actions_are_sampled_as_by_workers(spec: EnvSpec) -> None:
    """Actions have the policy's frequencies; forbidden ones never occur, and absent agents get 0."""
    learner = OnPolicyLearner(COMA if spec is STATE else OTHERS, spec, (1, 2), "cpu")
    made = fabricate(spec, 1, 4, seed=0, absent=0.3)
    one = CriticBatch.after_last_step(made)
    many = 4000

    def repeated(array: NDArray[Any] | None) -> Any:  # noqa: ANN401 - as it came
        return None if array is None else np.repeat(array, many, axis=0)

    scene = CriticBatch(
        *(repeated(a) for a in (one.observations, one.states, one.present, one.in_joint, one.masks))
    )
    random = [generator(seed, "test") for seed in (1, 2)]
    drawn = learner.behaviour.with_drawn_actions(scene, random).actions
    assert drawn is not None
    assert (drawn[~scene.present] == 0).all()
    if spec is STATE:
        chances = learner.behaviour.probabilities(one)[0]
        shares = (drawn[..., None] == np.arange(3)).mean(axis=0)
        np.testing.assert_allclose(shares[one.present[0]], chances[one.present[0]], atol=0.04)
        assert one.masks is not None
        assert (shares[~one.masks[0] & one.present[0][..., None]] == 0).all()
    else:
        np.testing.assert_allclose(drawn.std(axis=0)[one.present[0]], np.exp(-0.5), rtol=0.05)


def test_central_critics_see_the_state_and_with_individual_rewards_the_own_observation() -> None:
    config = configure("mappo", **{**SETTINGS, "normalise_observations": False}, policies="shared")
    made = fabricate(STATE, 5, 2, seed=0)
    inputs = _inputs(OnPolicyLearner(config, STATE, (1,), "cpu"), made)
    np.testing.assert_array_equal(inputs[..., :5], np.repeat(made.states[:-1, :, None], 4, axis=2))
    np.testing.assert_array_equal(inputs[..., 5:], made.observations[:-1])
    made = fabricate(TEAM, 5, 2, seed=0, absent=0.2)
    of_team = _inputs(OnPolicyLearner(config, TEAM, (1,), "cpu"), made)
    np.testing.assert_array_equal(of_team, made.states[:-1, :, None])
