"""Learners that stay near the policies with which they started."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from learned import assert_equal, joined, reloaded, tensors
from made_trajectories import fabricate
from torch import Tensor
from torch.distributions import Categorical, Distribution, Independent, Normal, kl_divergence

from headway.contracts import AnchoredLearner, Box, Discrete, EnvSpec, MultiDiscrete, Trajectory, generator
from headway_algos.batches.old_policies import OldPolicies
from headway_algos.batches.policy_batch import PolicyBatch
from headway_algos.config import ModelConfig
from headway_algos.on_policy.split_learner import SplitLearner
from headway_algos.on_policy.updates.gradient_update import GradientUpdate
from headway_algos.on_policy.warm_start import WarmStartLearner
from headway_algos.registry import ENTRIES, configure

SPEC = EnvSpec("made", ("a", "b"), 3, Discrete(3), state_size=2)
MASKED = replace(SPEC, has_action_mask=True, agents_come_and_go=True)
TWO_CHOICES = replace(SPEC, action_space=MultiDiscrete((3, 2)))
BOX = replace(SPEC, action_space=Box((-1.0, -1.0), (1.0, 1.0)))
MODEL = ModelConfig(hidden=(16, 16), actor_gain=1.0)


def _learner(
    algorithm: str,
    spec: EnvSpec,
    seeds: tuple[int, ...] = (3,),
    **settings: Any,  # noqa: ANN401 - hyper-parameters
) -> AnchoredLearner:
    config = configure(algorithm, **{"model": MODEL, "lr": 3e-3, **settings})
    learner = ENTRIES[algorithm].learner(config, spec, seeds, "cpu")
    assert isinstance(learner, AnchoredLearner)
    return learner


def _one(learner: AnchoredLearner) -> WarmStartLearner:
    assert isinstance(learner, WarmStartLearner)
    return learner


def _distributions(learner: WarmStartLearner, observations: Tensor) -> list[Distribution]:
    """Return torch's distributions of the actor at raw observations (P, B, D)."""
    actor = learner.actor
    with torch.no_grad():
        outputs = actor.network(actor.moments.normalised(observations)).transpose(1, 2)
        if actor.nvec:
            return [Categorical(logits=part) for part in outputs.split(list(actor.nvec), 2)]
        if actor.log_std is None:
            return [Categorical(logits=outputs)]
        return [Independent(Normal(outputs, actor.log_std.transpose(1, 2).exp()), 1)]


def _distance(before: list[Distribution], after: list[Distribution]) -> float:
    parts = [kl_divergence(old, new) for old, new in zip(before, after, strict=True)]
    return float(torch.stack(parts).sum(0).mean())


def _moved(algorithm: str, spec: EnvSpec, coefficient: float, settings: dict[str, Any]) -> float:
    """Return the mean KL(start || policy), by torch, after ten updates on random data."""
    learner = _one(_learner(algorithm, spec, normalise_observations=False, **settings))
    draw = np.random.default_rng(8)
    stack = len(learner.acting_parameters()["weight_0"])
    observations = torch.from_numpy(1 + 2 * draw.standard_normal((stack, 500, 3)).astype(np.float32))
    before = _distributions(learner, observations)
    for iteration in range(1, 11):
        learner.anchor(coefficient, critic_only=False)
        learner.update(fabricate(spec, 32, 8, seed=1, absent=0.1), iteration, 0.0)
    return _distance(before, _distributions(learner, observations))


@pytest.mark.parametrize(
    ("algorithm", "spec", "settings"),
    [
        ("ippo", SPEC, {"policies": "independent"}),
        ("ippo", SPEC, {"kl_coeff": 0.2}),
        ("mappo", TWO_CHOICES, {}),
        ("happo", BOX, {"policies": "independent"}),
        ("ia2c", MASKED, {"epochs": 1}),
        ("coma", SPEC, {}),
    ],
)
def test_a_large_penalty_holds_policies_where_they_started(
    algorithm: str, spec: EnvSpec, settings: dict[str, Any]
) -> None:
    settings = {"agent_id": False, **settings}
    free, held = (_moved(algorithm, spec, coefficient, settings) for coefficient in (0.0, 1e4))
    assert held < free / 10
    assert held < 2e-3


@pytest.mark.parametrize("precision", ["float32", "float64"])
@pytest.mark.parametrize("algorithm", ["ippo", "ia2c"])
@pytest.mark.parametrize("spec", [SPEC, BOX])
def test_the_gradient_is_that_of_the_divergence_from_the_start(
    spec: EnvSpec, algorithm: str, precision: str
) -> None:
    """Compiled and by autograd: without advantages and entropy it is the whole gradient."""
    settings = {"precision": precision, "entropy_coeff": 0.0, "grad_clip": None, "agent_id": False}
    learner, other = (_one(_learner(algorithm, spec, (seed,), **settings)) for seed in (3, 4))
    update, dtype = learner.policy_update, learner.dtype
    assert isinstance(update, GradientUpdate)
    update.epochs = update.minibatches = 1
    draw = np.random.default_rng(5)
    observations = torch.from_numpy(draw.standard_normal((1, 90, 3))).to(dtype)
    old, new = (_distributions_with_gradient(each, observations) for each in (other, learner))
    kl_divergence(old, new).mean().backward()
    expected = torch.cat([p.grad.flatten() for p in learner.actor.learnable if p.grad is not None]).norm()
    for parameter in learner.actor.learnable:
        parameter.grad = None
    with torch.no_grad():
        actions = new.sample()
        log_probs = new.log_prob(actions)
    start = OldPolicies.of(other.actor, observations, None, torch.full((1,), 7.0, dtype=dtype), 5120)
    rows = PolicyBatch(observations, None, actions, log_probs, np.ones((1, 90), np.bool_), start=start)
    info = update.improve(rows, torch.zeros_like(log_probs), [generator(1, "test")])
    assert float(info["gradient_norm"]) == pytest.approx(7 * float(expected), rel=1e-4)


def _distributions_with_gradient(learner: WarmStartLearner, observations: Tensor) -> Distribution:
    outputs = learner.actor.network(observations).transpose(1, 2)
    if learner.actor.log_std is None:
        return Categorical(logits=outputs)
    return Independent(Normal(outputs, learner.actor.log_std.transpose(1, 2).exp()), 1)


def test_the_distance_is_from_the_start_with_its_own_normaliser() -> None:
    learner = _one(_learner("ippo", SPEC, agent_id=False, policies="shared"))
    for iteration in range(1, 4):
        trajectory = fabricate(SPEC, 32, 4, seed=iteration)
        trajectory.observations[:] = 5 * iteration + iteration * trajectory.observations
        seen = torch.from_numpy(trajectory.observations[:-1].reshape(1, -1, 3))
        if iteration == 2:  # the first with a penalty
            start = learner._copy_of_actor()
        moments = {n: b.clone() for n, b in learner.actor.moments.named_buffers()}
        learner.anchor(0.1 * (iteration > 1), critic_only=False)
        metrics = learner.update(trajectory, iteration, 0.0)
        if iteration == 1:
            assert "policy/start_kl" not in metrics
            continue
        with torch.no_grad():
            old = Categorical(logits=start.network(start.moments.normalised(seen)).transpose(1, 2))
            # Policies were trained on observations as they were normalised before the update.
            for name, buffer in learner.actor.moments.named_buffers():
                moments[name], buffer.data = buffer.clone(), moments[name]
            new = _distributions(learner, seen)[0]
            for name, buffer in learner.actor.moments.named_buffers():
                buffer.data = moments[name]
        expected = float(kl_divergence(old, new).mean())
        assert metrics["policy/start_kl"][0] == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize("algorithm", ["ippo", "hatrpo", "maacktr", "coma"])
def test_only_critic_and_normalisers_learn_if_told(algorithm: str) -> None:
    learner = _learner(algorithm, SPEC, **({"policies": "independent"} if algorithm == "hatrpo" else {}))
    before = tensors(learner.state_dict())
    for iteration in (1, 2, 3):
        learner.anchor(0.0, critic_only=True)
        learner.update(fabricate(SPEC, 32, 4, seed=iteration), iteration, 0.1)
    after = tensors(learner.state_dict())
    changed = {name for name in before if not np.array_equal(before[name], after[name])}
    assert not [n for n in changed if n.startswith(("actor network", "policy_update"))]
    assert any(n.startswith("actor moments") for n in changed)
    assert any(n.startswith("critic networks network") for n in changed)
    learner.anchor(0.0, critic_only=False)
    learner.update(fabricate(SPEC, 32, 4, seed=4), 4, 0.1)
    last = tensors(learner.state_dict())
    assert any(n.startswith("actor network") and not np.array_equal(last[n], after[n]) for n in last)


def _train(learner: AnchoredLearner, trajectories: list[Trajectory], first: int) -> None:
    for iteration, trajectory in enumerate(trajectories, start=first):
        learner.anchor(1.0 / iteration, critic_only=iteration == 1)
        learner.update(trajectory, iteration, 0.1 * iteration)


@pytest.mark.parametrize("settings", [{}, {"shared_until": 0.25}, {"shared_until": 0.9}])
def test_a_learner_that_is_reloaded_goes_on_from_the_same_start(settings: dict[str, Any]) -> None:
    trajectories = [fabricate(SPEC, 32, 4, seed=seed) for seed in range(6)]
    settings = {"policies": "independent", **settings}
    whole, first, second = (_learner("ippo", SPEC, (3, 4), **settings) for _ in range(3))
    _train(whole, trajectories, 1)
    _train(first, trajectories[:3], 1)
    second.load_state_dict(reloaded(first.state_dict()))
    _train(second, trajectories[3:], 4)
    assert_equal(tensors(second.state_dict()), tensors(whole.state_dict()))


def test_policies_that_were_split_are_held_where_the_shared_one_started() -> None:
    settings = {"policies": "independent", "shared_until": 0.25, "normalise_observations": False}
    moved = []
    for coefficient in (0.0, 1e4):
        learner = _learner("ippo", SPEC, **settings)
        assert isinstance(learner, SplitLearner)
        observations = torch.from_numpy(np.random.default_rng(8).standard_normal((1, 500, 3)))
        before = _distributions(learner.shared, observations.float())
        for iteration in range(1, 13):
            learner.anchor(coefficient, critic_only=False)
            learner.update(fabricate(SPEC, 32, 8, seed=1), iteration, iteration / 13)
        assert learner.is_split
        after = _distributions(learner.separate, observations.float().expand(2, -1, -1))
        moved.append(_distance(before, after))
    assert moved[1] < min(2e-3, moved[0] / 10)


def test_seeds_of_a_stack_are_held_as_each_would_be_alone() -> None:
    tracks = [[fabricate(BOX, 32, 4, seed=10 * seed + i) for i in range(3)] for seed in (1, 2)]
    stacked, alone = _learner("mappo", BOX, (1, 2)), [_learner("mappo", BOX, (seed,)) for seed in (1, 2)]
    _train(stacked, [joined([track[i] for track in tracks]) for i in range(3)], 1)
    for learner, track in zip(alone, tracks, strict=True):
        _train(learner, track, 1)
    for name, array in stacked.acting_parameters().items():
        parts = [learner.acting_parameters()[name] for learner in alone]
        np.testing.assert_array_equal(array, np.concatenate(parts))
