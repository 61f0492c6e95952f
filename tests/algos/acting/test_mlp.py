"""The numpy acting policy against the torch actor, and its samples against its probabilities."""

from itertools import product
from typing import Any, Literal

import numpy as np
import pytest
import torch
from covering import pairwise
from made_observations import AGENTS, SIZE, drawn, repeated, seen, spec_with
from numpy.typing import NDArray

from headway.contracts import ActionSpace, Box, Discrete, EnvSpec, MultiDiscrete, Observations, generator
from headway_algos.acting.mlp import MLPActingPolicy
from headway_algos.config import ModelConfig
from headway_algos.on_policy.learner import OnPolicyLearner
from headway_algos.registry import configure

COPIES = 6
Policies = Literal["independent", "shared", "groups"]
Precision = Literal["float32", "float64"]
SPACES: dict[str, ActionSpace] = {
    "discrete": Discrete(4),
    "several": MultiDiscrete((2, 3, 1)),
    "box": Box((-1.0, -1.0), (1.0, 1.0)),
}


def _learner(
    spec: EnvSpec,
    policies: Policies,
    precision: Precision,
    seeds: tuple[int, ...],
    activation: Literal["tanh", "relu"] = "tanh",
    normalise: bool = True,
) -> tuple[OnPolicyLearner, MLPActingPolicy]:
    """Policies far from uniform, with a used normaliser."""
    model = ModelConfig(hidden=(8, 7), activation=activation, actor_gain=1.5)
    config = configure(
        "custom", policies=policies, agent_id=False, model=model, precision=precision,
        normalise_observations=normalise,
    )  # fmt: skip
    learner = OnPolicyLearner(config, spec, seeds, "cpu")
    random = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for bias in learner.actor.network.biases:
            bias.normal_(generator=random)
    if normalise:
        stack = len(learner.actor.network.weights[0])
        learner.actor.moments.include(1 + 2 * torch.randn(stack, 50, SIZE, generator=random))
    return learner, MLPActingPolicy.of(config, spec)


def _torch_log_probs(
    learner: OnPolicyLearner, observed: Observations, actions: NDArray[Any]
) -> NDArray[np.float64]:
    """(C, N), by the learner's layout of rows."""
    layout = learner.layout
    rows = layout.rows(observed.observations[None])
    if learner.config.normalise_observations:
        rows = learner.actor.moments.normalised(rows)
    masks = None if observed.action_masks is None else layout.rows(observed.action_masks[None])
    with torch.no_grad():
        log_probs = learner.actor(rows, masks).log_prob(layout.rows(actions[None]))
    by_agent: NDArray[np.float64] = layout.by_agent(log_probs, 1)[0]
    return by_agent


@pytest.mark.parametrize(
    ("space", "policies", "precision", "replicas", "activation", "normalise"),
    pairwise(
        SPACES,
        ["independent", "shared", "groups"],
        ["float32", "float64"],
        [1, 3],
        ["tanh", "relu"],
        [True, False],
    ),
)
def test_log_probabilities_equal_torch(
    space: str,
    policies: Policies,
    precision: Precision,
    replicas: int,
    activation: Literal["tanh", "relu"],
    normalise: bool,
) -> None:
    """The parameters cover observations that a normaliser would clip, with and without normalisation."""
    spec = spec_with(SPACES[space])
    learner, acting = _learner(spec, policies, precision, tuple(range(replicas)), activation, normalise)
    observed = drawn(spec.action_space, replicas * COPIES)
    if not normalise:
        observed.observations[...] *= 30
    random = np.random.default_rng(1)
    noise = np.stack([acting.noise(random, 1)[0] for _ in range(replicas * COPIES)])
    for draws in (noise, None):
        actions, log_probs = acting.act(learner.acting_parameters(), observed, draws)
        expected = _torch_log_probs(learner, observed, actions)
        tolerance = 1e-5 if precision == "float32" else 1e-12
        np.testing.assert_allclose(log_probs, expected, rtol=tolerance, atol=tolerance)
        assert log_probs.dtype == np.float64


def test_each_group_follows_its_own_policy() -> None:
    """x = agents 0, 2, 4; y = 1; z = 3: the same observation gives the same outputs within a group only."""
    spec = spec_with(SPACES["box"])
    learner, acting = _learner(spec, "groups", "float64", (0, 1))
    observed = drawn(spec.action_space, 2)
    observed.observations[...] = 0.7
    actions, _ = acting.act(learner.acting_parameters(), observed, None)
    for replica in actions:
        np.testing.assert_array_equal(replica[0], replica[2])
        np.testing.assert_array_equal(replica[0], replica[4])
        assert len({tuple(action) for action in replica.tolist()}) == 3
    assert not np.isin(actions[0], actions[1]).any()


def _sampled(
    learner: OnPolicyLearner, acting: MLPActingPolicy, one: Observations, draws: int
) -> NDArray[Any]:
    """Actions drawn for the same observations of one copy, (draws, N, ...)."""
    noise = acting.noise(generator(0, "action"), draws)
    return acting.act(learner.acting_parameters(), repeated(one, draws), noise)[0]


@pytest.mark.parametrize(("space", "choices"), [("discrete", (4,)), ("several", (2, 3, 1))])
def test_frequencies_of_sampled_actions_are_the_probabilities(space: str, choices: tuple[int, ...]) -> None:
    """Each choice of a MultiDiscrete action is drawn independently, among its allowed options."""
    spec, draws = spec_with(SPACES[space]), 40_000
    learner, acting = _learner(spec, "shared", "float64", (0,))
    one = drawn(spec.action_space, 1)
    assert one.action_masks is not None
    actions = _sampled(learner, acting, one, draws)
    first = np.cumsum([0, *choices[:-1]])  # each choice's first option among all
    for agent, options in product(range(AGENTS), np.ndindex(*choices)):
        asked = np.tile(options, (1, AGENTS, 1)).reshape(1, *actions.shape[1:])
        p = float(np.exp(_torch_log_probs(learner, one, asked)[0, agent]))
        frequency = float((actions.reshape(draws, AGENTS, -1)[:, agent] == options).all(axis=-1).mean())
        if one.action_masks[0, agent, first + options].all():
            assert abs(frequency - p) < 5 * np.sqrt(p * (1 - p) / draws) + 1e-9
        else:
            assert frequency == 0


@pytest.mark.parametrize("uniform", [0.0, 0.5, 1 - 2**-53])
def test_forbidden_actions_are_never_sampled_at_the_edges_of_the_uniform(uniform: float) -> None:
    spec = spec_with(SPACES["discrete"])
    for precision in ("float32", "float64"):
        learner, acting = _learner(spec, "shared", precision, (0,))
        observed = drawn(spec.action_space, 500, seed=7)
        assert observed.action_masks is not None
        noise = np.full((500, AGENTS), uniform)
        actions, log_probs = acting.act(learner.acting_parameters(), observed, noise)
        assert np.take_along_axis(observed.action_masks, actions[..., None], -1).all()
        assert np.isfinite(log_probs).all()


def test_gaussian_actions_have_the_mean_and_deviation_of_the_policy() -> None:
    spec, draws = spec_with(SPACES["box"]), 40_000
    learner, acting = _learner(spec, "independent", "float64", (0,))
    one = drawn(spec.action_space, 1)
    actions = _sampled(learner, acting, one, draws)
    mean, _ = acting.act(learner.acting_parameters(), one, None)
    std = np.exp(-0.5)
    np.testing.assert_allclose(actions.mean(axis=0), mean[0], atol=5 * std / np.sqrt(draws))
    np.testing.assert_allclose(actions.std(axis=0), std, rtol=5 / np.sqrt(2 * draws))


def test_greedy_actions_are_the_mode() -> None:
    spec = spec_with(SPACES["discrete"])
    learner, acting = _learner(spec, "groups", "float64", (0,))
    observed = drawn(spec.action_space, COPIES)
    greedy, _ = acting.act(learner.acting_parameters(), observed, None)
    every = [_torch_log_probs(learner, observed, np.full((COPIES, AGENTS), a)) for a in range(4)]
    np.testing.assert_array_equal(greedy, np.argmax(every, axis=0))


def test_a_single_agents_observations_are_not_modified() -> None:
    """One agent: rows by policy are a view of the environment's array."""
    spec = EnvSpec("made", ("only",), SIZE, Discrete(2), agents_come_and_go=True)
    config = configure("custom", model=ModelConfig(hidden=(4,)))
    learner, acting = OnPolicyLearner(config, spec, (0,), "cpu"), MLPActingPolicy.of(config, spec)
    observations = np.full((2, 1, SIZE), np.nan, np.float32)
    observed = seen(observations, alive=np.zeros((2, 1), np.bool_))
    acting.act(learner.acting_parameters(), observed, None)
    assert np.isnan(observations).all()
