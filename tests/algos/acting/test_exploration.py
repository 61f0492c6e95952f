"""Acting policies of the off-policy algorithms against torch's networks, and their exploration."""

from dataclasses import replace
from typing import Any, Literal

import numpy as np
import pytest
import torch
from covering import pairwise
from made_observations import AGENTS, SIZE, drawn, repeated, seen, spec_with
from numpy.typing import NDArray

from headway.contracts import ActionSpace, Box, Discrete, EnvSpec, Observations, RecurrentPolicy, generator
from headway_algos.acting.exploration import OrnsteinUhlenbeckPolicy
from headway_algos.off_policy.ddpg import DeterministicPolicyGradient
from headway_algos.off_policy.dqn import QLearning
from headway_algos.off_policy.learner import OffPolicyLearner
from headway_algos.registry import ENTRIES
from headway_algos.replay_config import DDPGConfig, MADQNConfig, NetworkConfig

COPIES = 6
SPACES: dict[str, ActionSpace] = {"madqn": Discrete(4), "ddpg": Box((-1.0, 0.0), (3.0, 1.0))}
METHODS: dict[str, Any] = {"madqn": QLearning, "ddpg": DeterministicPolicyGradient}
Policies = Literal["independent", "shared", "groups"]


def _learner(
    algorithm: str, policies: Policies, precision: str, seeds: tuple[int, ...]
) -> tuple[OffPolicyLearner, Any]:
    """A learner with nonzero biases and a used normaliser, and its acting policy."""
    spec = spec_with(SPACES[algorithm])
    entry, model = ENTRIES[algorithm], NetworkConfig((8, 7), "relu")
    config = entry.config(policies=policies, agent_id=False, precision=precision, model=model)
    learner = OffPolicyLearner(config, spec, seeds, "cpu", METHODS[algorithm])
    random = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for parameter in learner.method.network.parameters():
            parameter += torch.randn(parameter.shape, generator=random, dtype=parameter.dtype)
    stack = len(learner.replay.filled)
    learner.moments.include(1 + 2 * torch.randn(stack, 50, SIZE, generator=random))
    return learner, entry.acting_policy(config, spec)


def _torch_outputs(learner: OffPolicyLearner, observed: Observations) -> NDArray[np.float64]:
    """(C, N, A), by the learner's layout of rows."""
    rows = learner.layout.rows(observed.observations[None])
    mean, scale = learner.moments.mean.to(learner.dtype), learner.moments.scale.to(learner.dtype)
    rows = ((rows - mean) * scale).clamp(-10, 10)
    with torch.no_grad():
        outputs = learner.method.network(rows).transpose(1, 2)
    by_agent: NDArray[np.float64] = learner.layout.by_agent(outputs, 1)[0]
    return by_agent


@pytest.mark.parametrize(
    ("policies", "precision", "replicas"),
    pairwise(["independent", "shared", "groups"], ["float32", "float64"], [1, 3]),
)
def test_greedy_actions_and_log_probs_equal_torch(policies: Policies, precision: str, replicas: int) -> None:
    spec = spec_with(SPACES["madqn"])
    learner, acting = _learner("madqn", policies, precision, tuple(range(replicas)))
    learner.progress = 0.3
    epsilon = learner.exploration
    assert 0.05 < epsilon < 1
    observed = drawn(spec.action_space, replicas * COPIES)
    assert observed.action_masks is not None
    values = _torch_outputs(learner, observed)
    np.testing.assert_allclose(
        acting.perceptron.outputs(learner.acting_parameters(), observed), values, rtol=1e-5, atol=1e-5
    )
    best = np.where(observed.action_masks, values, -np.inf).argmax(axis=-1)
    actions, _ = acting.act(learner.acting_parameters(), observed, None)
    np.testing.assert_array_equal(actions, best)
    noise = np.concatenate([acting.noise(generator(c, "action", 0), 1) for c in range(replicas * COPIES)])
    actions, log_probs = acting.act(learner.acting_parameters(), observed, noise)
    assert np.take_along_axis(observed.action_masks, actions[..., None], axis=-1).all()
    chance = epsilon / observed.action_masks.sum(axis=-1) + (1 - epsilon) * (actions == best)
    tolerance = 1e-5 if precision == "float32" else 1e-12
    np.testing.assert_allclose(log_probs, np.log(chance), rtol=tolerance, atol=tolerance)


@pytest.mark.parametrize(
    ("policies", "precision"), [("independent", "float64"), ("shared", "float32"), ("groups", "float32")]
)
def test_deterministic_actions_equal_torch_and_respect_the_bounds(policies: Policies, precision: str) -> None:
    spec = spec_with(SPACES["ddpg"])
    learner, acting = _learner("ddpg", policies, precision, (0, 1))
    observed = drawn(spec.action_space, 2 * COPIES)
    actions, log_probs = acting.act(learner.acting_parameters(), observed, None)
    expected = np.array([1.0, 0.5]) + np.array([2.0, 0.5]) * np.tanh(_torch_outputs(learner, observed))
    np.testing.assert_allclose(actions, expected, rtol=1e-5, atol=1e-5)
    assert not log_probs.any()
    assert actions.std() > 0.1


@pytest.mark.parametrize("epsilon", [0.0, 0.3, 1.0])
def test_epsilon_is_the_probability_of_a_random_allowed_action(epsilon: float) -> None:
    """Frequencies within 5 standard deviations; epsilon includes its share of the best action."""
    draws, spec = 40_000, spec_with(SPACES["madqn"])
    learner, acting = _learner("madqn", "shared", "float64", (0,))
    parameters = {**learner.acting_parameters(), "exploration": np.full((1, 1, 1), epsilon)}
    one = drawn(spec.action_space, 1)
    assert one.action_masks is not None
    best, _ = acting.act(parameters, one, None)
    actions, _ = acting.act(parameters, repeated(one, draws), acting.noise(generator(0, "action", 0), draws))
    for agent in range(AGENTS):
        allowed = one.action_masks[0, agent]
        chance = allowed * epsilon / allowed.sum() + (1 - epsilon) * (np.arange(4) == best[0, agent])
        frequency = np.bincount(actions[:, agent], minlength=4) / draws
        assert (frequency[~allowed] == 0).all()
        margin = 5 * np.sqrt(chance * (1 - chance) / draws)
        assert (np.abs(frequency - chance) <= margin + 1e-12).all()


def _ornstein_uhlenbeck(
    theta: float, sigma: float, agents: int
) -> tuple[OrnsteinUhlenbeckPolicy, dict[str, NDArray[Any]]]:
    """A policy with zero networks and bounds too wide to clip: actions are noise / 1e6."""
    names = tuple(f"a{i}" for i in range(agents))
    spec = EnvSpec("made", names, 1, Box((-1e6,), (1e6,)), agents_come_and_go=True)
    config = DDPGConfig(
        policies="shared", model=NetworkConfig(()), ou_theta=theta, ou_sigma=sigma, precision="float64"
    )
    policy = ENTRIES["ddpg"].acting_policy(config, spec)
    assert isinstance(policy, OrnsteinUhlenbeckPolicy)
    shapes = policy.parameter_shapes(1)
    parameters = {name: np.zeros(shape, dtype) for name, (shape, dtype) in shapes.items()}
    return policy, parameters | {"exploration": np.full((1, 1, 1), 1e-6)}


@pytest.mark.parametrize(("theta", "sigma"), [(0.15, 0.2), (0.5, 1.0), (1.0, 0.3)])
def test_noise_has_variance_and_autocorrelation_of_ornstein_uhlenbeck(theta: float, sigma: float) -> None:
    """Discretised with step 1: variance sigma^2 / (1 - (1 - theta)^2), autocorrelation (1 - theta)^lag."""
    agents, steps = 400, 300
    policy, parameters = _ornstein_uhlenbeck(theta, sigma, agents)
    assert isinstance(policy, RecurrentPolicy)
    noise = policy.noise(generator(0, "action", 0), steps)
    memory = np.zeros((1, agents, policy.hidden_size))
    observed = seen(np.zeros((1, agents, 1), np.float32))
    path = np.empty((steps, agents))
    for t in range(steps):
        actions, _, memory = policy.act_from(parameters, observed, memory, noise[t][None])
        path[t] = actions[0, :, 0]
        np.testing.assert_allclose(actions, memory, rtol=1e-5)
    late = path[100:]
    variance = sigma**2 / (1 - (1 - theta) ** 2)
    assert late.var() == pytest.approx(variance, rel=0.05)
    assert abs(late.mean()) < 0.1 * np.sqrt(variance)
    for lag in (1, 4):
        correlation = (late[lag:] * late[:-lag]).mean() / late.var()
        assert correlation == pytest.approx((1 - theta) ** lag, abs=0.03)
    assert path[0].std() == pytest.approx(sigma, rel=0.15)  # it begins at 0


def test_noise_is_unchanged_while_an_agent_is_absent_or_acts_greedily() -> None:
    policy, parameters = _ornstein_uhlenbeck(0.15, 0.2, 2)
    observed = seen(np.zeros((1, 2, 1), np.float32), alive=np.array([[True, False]]))
    memory = np.array([[[0.5], [0.7]]])
    noise = policy.noise(generator(0, "action", 0), 1)[0][None]
    _, _, after = policy.act_from(parameters, observed, memory, noise)
    assert after[0, 0, 0] == pytest.approx(0.85 * 0.5 + 0.2 * noise[0, 0, 0])
    assert after[0, 1, 0] == 0.7
    actions, _, greedy = policy.act_from(parameters, observed, memory, None)
    np.testing.assert_array_equal(greedy, memory)
    assert not actions.any()


def test_noisy_actions_stay_within_the_bounds() -> None:
    spec = spec_with(SPACES["ddpg"])
    learner, acting = _learner("ddpg", "shared", "float32", (0,))
    noise = 20 * acting.noise(generator(0, "action", 0), COPIES)
    actions, _ = acting.act(learner.acting_parameters(), drawn(spec.action_space, COPIES), noise)
    assert (actions >= np.float32([-1, 0])).all()
    assert (actions <= np.float32([3, 1])).all()
    assert {-1.0, 3.0} <= set(actions[..., 0].ravel().tolist())


def test_where_bounds_are_equal_that_value_is_acted_however_much_is_explored() -> None:
    spec = EnvSpec("made", ("a", "b"), 1, Box((-1.0, 0.3), (1.0, 0.3)))
    config = DDPGConfig(policies="shared")
    learner = ENTRIES["ddpg"].learner(config, spec, (0,), "cpu")
    acting = ENTRIES["ddpg"].acting_policy(config, spec)
    observed = seen(np.ones((50, 2, 1), np.float32))
    parameters = {**learner.acting_parameters(), "exploration": np.full((1, 1, 1), 5.0)}
    actions, _ = acting.act(parameters, observed, acting.noise(generator(0, "action", 0), 50))
    assert (actions[..., 1] == np.float32(0.3)).all()
    assert actions[..., 0].std() > 0.1


def test_exploration_follows_its_schedule() -> None:
    linear = MADQNConfig(exploration_start=0.9, exploration_end=0.1, exploration_share=0.4)
    assert [round(linear.exploration(p, 7), 12) for p in (0, 0.1, 0.2, 0.4, 1)] == [0.9, 0.7, 0.5, 0.1, 0.1]
    at_once = replace(linear, exploration_share=0.0)
    assert at_once.exploration(0, 0) == 0.1
    with pytest.raises(ValueError, match="exploration_share or exploration_decay_steps, not both"):
        replace(linear, exploration_decay_steps=1000.0)
    exponential = MADQNConfig(exploration_start=0.9, exploration_end=0.1, exploration_decay_steps=1000.0)
    assert exponential.exploration(0.9, 0) == pytest.approx(0.9)
    assert exponential.exploration(0.9, 1000) == pytest.approx(0.1 + 0.8 / np.e)
    assert exponential.exploration(0.0, 10**6) == pytest.approx(0.1)
