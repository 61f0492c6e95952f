"""Policies that imitate a rule's actions."""

from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest
from learned import assert_equal, joined, starting_learner, tensors
from made_trajectories import fabricate
from numpy.typing import NDArray

from headway.contracts import (
    Box,
    Discrete,
    EnvSpec,
    MultiDiscrete,
    Observations,
    RecurrentPolicy,
    Trajectory,
)
from headway_algos.acting.policy import acting_policy
from headway_algos.config import ModelConfig
from headway_algos.on_policy.warm_start import WarmStartLearner
from headway_algos.registry import ENTRIES, configure

SPEC = EnvSpec("made", ("a", "b"), 3, Discrete(3), state_size=2)
MASKED = replace(SPEC, has_action_mask=True, agents_come_and_go=True)
TWO_CHOICES = replace(SPEC, action_space=MultiDiscrete((3, 2)))
BOX = replace(SPEC, action_space=Box((-1.0, -1.0), (1.0, 1.0)))
MODEL = ModelConfig(hidden=(16, 16))
POLICY = acting_policy(configure("ippo", model=MODEL), SPEC)
_learner = partial(starting_learner, model=MODEL)
GRU = ModelConfig(hidden=(16,), core="gru", gru_size=8, sequence_length=5)
SCORES = np.array([[1.0, -0.6, 0.2], [-0.4, 0.9, 0.5], [0.1, 0.3, -1.2]])
"""(D, A): the rule's linear scores of the actions."""


def _rule_actions(spec: EnvSpec, observations: NDArray[np.float32], masks: NDArray[np.bool_]) -> NDArray[Any]:
    """Return the best allowed action by linear scores; for Box actions, two bounded scores themselves."""
    scores = observations @ SCORES
    if isinstance(spec.action_space, Box):
        return np.tanh(scores[..., :2]).astype(np.float32)
    if isinstance(spec.action_space, MultiDiscrete):
        return np.stack([scores.argmax(axis=-1), (scores[..., 0] > 1).astype(np.int64)], axis=-1)
    return np.where(masks if len(masks) else True, scores, -np.inf).argmax(axis=-1)


def _played_by_rule(spec: EnvSpec, hidden_size: int, seed: int, copies: int) -> Trajectory:
    """Return a random trajectory, with NaN in rows of absent agents, in which the rule acted."""
    made = fabricate(spec, 64, copies, seed=seed, absent=0.2, idle=0.2, hidden_size=hidden_size)
    made.actions[:] = _rule_actions(spec, made.observations[:-1], made.action_masks[:-1])
    made.log_probs[:] = 0
    made.observations[~made.alive] = np.nan
    return made


@pytest.mark.parametrize(
    ("algorithm", "spec", "settings", "seeds"),
    [
        ("ippo", MASKED, {}, (3,)),
        ("mappo", SPEC, {"model": GRU}, (3,)),
        ("itrpo", TWO_CHOICES, {}, (3,)),
        ("maacktr", BOX, {}, (3,)),
        ("coma", MASKED, {"precision": "float64"}, (3, 4)),
        ("happo", BOX, {"policies": "independent"}, (3, 4)),
        ("ia2c", SPEC, {"policies": "independent", "shared_until": 0.5}, (3,)),
    ],
)
def test_greedy_actions_become_those_of_the_rule(
    algorithm: str, spec: EnvSpec, settings: dict[str, Any], seeds: tuple[int, ...]
) -> None:
    learner = _learner(algorithm, spec, seeds, **settings)
    policy = ENTRIES[algorithm].acting_policy(configure(algorithm, **{"model": MODEL, **settings}), spec)
    hidden_size = policy.hidden_size if isinstance(policy, RecurrentPolicy) else 0
    before = learner.acting_parameters()
    for iteration in range(1, 16):
        trajectory = _played_by_rule(spec, hidden_size, iteration, 8 * len(seeds))
        metrics = learner.imitate(trajectory, iteration, 15)
        assert all(value.shape == (len(seeds),) for value in metrics.values())
    new = fabricate(spec, 32, len(seeds), seed=99)
    masks = new.action_masks[:-1]
    expected = _rule_actions(spec, new.observations[:-1], masks)
    alike = []
    for t in range(len(new.rewards)):
        observed = Observations(
            new.observations[t], new.states[t], new.alive[t], masks[t] if len(masks) else None
        )
        if isinstance(policy, RecurrentPolicy):
            nothing = np.zeros((*new.alive[t].shape, hidden_size))
            actions = policy.act_from(learner.acting_parameters(), observed, nothing, None)[0]
        else:
            actions = policy.act(learner.acting_parameters(), observed, None)[0]
        alike.append(np.abs(actions - expected[t]) < (0.2 if isinstance(spec.action_space, Box) else 0.5))
    assert np.mean(alike) > 0.95
    if "log_std" in before:
        np.testing.assert_array_equal(learner.acting_parameters()["log_std"], before["log_std"])


def _agreement(iterations: int) -> float:
    """Return how many greedy actions are the rule's, on observations far from 0, after imitation."""
    learner = _learner("ippo", SPEC)
    for iteration in range(1, iterations + 1):
        made = fabricate(SPEC, 128 // iterations, 64, seed=iteration)
        made.actions[:] = _rule_actions(SPEC, made.observations[:-1], made.action_masks)
        made.observations[:] = 30 + 10 * made.observations
        learner.imitate(made, iteration, iterations)
    new = fabricate(SPEC, 32, 1, seed=99)
    expected = _rule_actions(SPEC, new.observations[:-1], new.action_masks)
    parameters = learner.acting_parameters()
    seen = (30 + 10 * new.observations).astype(np.float32)
    steps = range(len(new.rewards))
    observed = [Observations(seen[t], new.states[t], new.alive[t]) for t in steps]
    return float(np.mean([POLICY.act(parameters, observed[t], None)[0] == expected[t] for t in steps]))


def test_one_iteration_is_enough_whatever_the_scale_of_observations() -> None:
    for iterations in (1, 2):
        assert _agreement(iterations) > 0.95


@pytest.mark.parametrize("coeff", [0.3, 1.0])
def test_the_entropy_coefficient_sets_how_random_the_policy_stays(coeff: float) -> None:
    """The rule takes one of two actions. Its probability p minimises -log p - coeff H(p): the derivative with
    respect to the log-odds z, (1 - p) (coeff p z - 1), is 0 at z = 1 / (coeff p)."""
    spec = replace(SPEC, action_space=Discrete(2))
    made = fabricate(spec, 64, 64, seed=1)
    made.actions[:] = 0
    entropy = _learner("ippo", spec, imitation_entropy_coeff=coeff).imitate(made, 1, 1)["policy/entropy"][0]
    p = 1.0
    for _ in range(100):
        p = 1 / (1 + np.exp(-1 / (coeff * p)))
    assert entropy == pytest.approx(-p * np.log(p) - (1 - p) * np.log(1 - p), rel=0.02)


@pytest.mark.parametrize("groups", [(), ("left", "right")])
def test_separate_policies_of_one_group_learn_from_the_decisions_of_all(groups: tuple[str, ...]) -> None:
    """Each agent meets states on one side of a plane only, and is asked about those of the other side."""
    spec = replace(SPEC, groups=groups)
    learner = _learner("happo", spec, policies="independent", normalise_observations=False)
    made = fabricate(spec, 128, 64, seed=1)
    sides = np.array([1, -1])[:, None] * np.array([0.4, -0.3, 0.9])
    for agent, side in enumerate(sides):
        across = made.observations[:, :, agent] @ side < 0
        made.observations[:, :, agent][across] *= -1
    made.actions[:] = _rule_actions(spec, made.observations[:-1], made.action_masks)
    learner.imitate(made, 1, 1)
    asked = -made.observations[0]
    policy = acting_policy(configure("happo", model=MODEL, policies="independent"), spec)
    observed = Observations(asked, made.states[0], made.alive[0])
    acted = policy.act(learner.acting_parameters(), observed, None)[0]
    agreement = np.mean(acted == _rule_actions(spec, asked, made.action_masks))
    assert agreement < 0.8 if groups else agreement > 0.95


def test_policies_become_copies_within_their_group_and_seed() -> None:
    """Also with groups of different sizes whose agents alternate, and seeds that are trained together."""
    spec = replace(SPEC, agents=("a", "b", "c"), groups=("x", "y", "x"))
    seeds, networks = (3, 4), []
    made = [_played_by_rule(spec, 0, seed, 8) for seed in seeds]
    for chosen, trajectory in [((seed,), [one]) for seed, one in zip(seeds, made, strict=True)] + [
        (seeds, made)
    ]:
        learner = _learner("happo", spec, chosen, policies="independent", normalise_observations=False)
        learner.imitate(joined(trajectory), 1, 1)
        networks.append(learner.acting_parameters()["weight_0"])
    first, second, both = networks
    np.testing.assert_array_equal(both, np.concatenate([first, second]))
    for own in (first, second):
        np.testing.assert_array_equal(own[0], own[2])
        assert (own[0] != own[1]).any()
    assert (first[0] != second[0]).any()


def test_policies_of_a_group_act_alike_although_each_agent_sees_one_part() -> None:
    """Agent b's observations are far from agent a's."""
    spec = replace(SPEC, groups=("x", "x"))
    learner = _learner("happo", spec, policies="independent")
    made = fabricate(spec, 64, 8, seed=1)
    made.observations[:, :, 1] = 30 + 10 * made.observations[:, :, 1]
    made.actions[:] = _rule_actions(spec, made.observations[:-1], made.action_masks)
    learner.imitate(made, 1, 1)
    policy = acting_policy(configure("happo", model=MODEL, policies="independent"), spec)
    for seen in made.observations[0, 0]:
        observed = Observations(np.tile(seen, (1, 2, 1)), made.states[0, :1], np.ones((1, 2), np.bool_))
        noise = np.full((1, 2, 3), 0.5)
        outputs = policy.act(learner.acting_parameters(), observed, noise)
        for one in outputs:
            np.testing.assert_array_equal(one[:, 0], one[:, 1])


def test_steps_of_recurrent_policies_shrink_towards_the_end() -> None:
    """Steps of Adam are proportional to the learning rate."""
    moved = []
    for iteration in (1, 100):
        learner = _learner("ippo", SPEC, model=GRU, precision="float64")
        before = learner.acting_parameters()["weight_0"].copy()
        learner.imitate(_played_by_rule(SPEC, 8, 1, 2), iteration, 100)
        moved.append(np.abs(learner.acting_parameters()["weight_0"] - before).max())
    assert moved[1] < moved[0] / 20


def test_the_critic_learns_the_returns_of_the_rule() -> None:
    """Every step pays 1 and ends its stream: the return of each is 1."""
    learner = _learner("mappo", SPEC, normalise_values=False)
    losses: list[float] = []
    for iteration in range(1, 11):
        trajectory = fabricate(SPEC, 64, 8, seed=iteration, ends=1.0)
        trajectory.rewards[:] = 1
        trajectory.truncated[:], trajectory.terminated[:] = False, True
        losses.append(learner.imitate(trajectory, iteration, 10)["critic/loss"][0])
    assert losses[0] > 0.5
    assert losses[-1] < 0.05


def test_actions_that_the_mask_forbids_teach_nothing() -> None:
    learner = _learner("ippo", MASKED, normalise_observations=False)
    before = tensors(learner.state_dict()["actor"])
    trajectory = _played_by_rule(MASKED, 0, 1, 8)
    trajectory.action_masks[:] = np.arange(3) != trajectory.actions.max()
    trajectory.actions[:] = trajectory.actions.max()
    learner.imitate(trajectory, 1, 1)
    networks = {name for name in before if "moments" not in name}
    after = tensors(learner.state_dict()["actor"])
    assert_equal({name: after[name] for name in networks}, {name: before[name] for name in networks})


@pytest.mark.slow
@pytest.mark.parametrize(("policies", "spec"), [("shared", MASKED), ("independent", SPEC), ("shared", BOX)])
def test_seeds_of_a_stack_imitate_as_each_would_alone(policies: str, spec: EnvSpec) -> None:
    """Although one has many decisions, one few and one none; all as one learner, as on a GPU."""
    config = configure("ippo", model=MODEL, precision="float64", policies=policies)
    tracks = []
    for number, absent in enumerate((0.1, 0.9, 0.1)):
        track = [fabricate(spec, 32, 4, seed=10 * number + i, absent=absent) for i in (1, 2)]
        for made in track:
            made.actions[:] = _rule_actions(spec, made.observations[:-1], made.action_masks[:-1])
            made.acting[:] &= number < 2
        tracks.append(track)
    stacked = WarmStartLearner(config, spec, (1, 2, 3), "cpu")
    alone = [WarmStartLearner(config, spec, (seed,), "cpu") for seed in (1, 2, 3)]
    for iteration in (1, 2):
        metrics = stacked.imitate(joined([track[iteration - 1] for track in tracks]), iteration, 2)
        for learner, track in zip(alone, tracks, strict=True):
            learner.imitate(track[iteration - 1], iteration, 2)
    assert np.isfinite(metrics["policy/entropy"]).tolist() == [True, True, False]
    for name, array in stacked.acting_parameters().items():
        parts = [learner.acting_parameters()[name] for learner in alone]
        np.testing.assert_allclose(array, np.concatenate(parts), rtol=1e-7, atol=1e-9)


def test_choices_that_are_rare_and_come_in_one_part_of_an_episode_are_imitated() -> None:
    """The rule takes action 2 in one of 250 decisions, and only the first of ten iterations shows it."""
    learner = _learner("ippo", SPEC)

    def rule(observations: NDArray[np.float32]) -> NDArray[np.bool_]:
        return observations[..., 0] > 2.65  # one of 250 draws of a standard normal

    for iteration in range(1, 11):
        made = fabricate(SPEC, 64, 16, seed=iteration)
        seen = made.observations[:-1]
        if iteration > 1:
            np.minimum(seen[..., 0], 2.0, out=seen[..., 0])
        made.actions[:] = np.where(rule(seen), 2, seen[..., 1] > 0)
        made.log_probs[:] = 0
        learner.imitate(made, iteration, 10)
    grid = np.stack(np.meshgrid([-1.0, 0.0, 2.4, 2.9, 3.2], [-1.0, 1.0], [0.0]), -1).reshape(-1, 3)
    parameters = learner.acting_parameters()
    for observed in grid.astype(np.float32):
        both = np.tile(observed, (1, 2, 1))
        chosen = POLICY.act(parameters, Observations(both, np.zeros((1, 2)), np.ones((1, 2), bool)), None)[0]
        assert (chosen == np.where(rule(both), 2, both[..., 1] > 0)).all(), observed
