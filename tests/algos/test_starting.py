"""Learners that start from the policies of another run."""

from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest
from learned import assert_equal, reloaded, starting_learner, tensors
from made_trajectories import fabricate

from headway.contracts import Box, Discrete, EnvSpec, HeadwayError
from headway_algos.config import ModelConfig
from headway_algos.replay_config import MADQNConfig

SPEC = EnvSpec("made", ("a", "b"), 3, Discrete(3), state_size=2)
BOX = replace(SPEC, action_space=Box((-1.0,), (1.0,)))
LARGER_STATE = replace(SPEC, state_size=4)
MODEL = ModelConfig(hidden=(8,))
_learner = partial(starting_learner, model=MODEL)
GRU = ModelConfig(hidden=(8,), core="gru", gru_size=4, sequence_length=5)


@pytest.mark.parametrize(
    ("algorithm", "spec", "settings"),
    [
        ("ippo", SPEC, {"policies": "independent"}),
        ("mappo", BOX, {}),
        ("coma", SPEC, {"model": GRU}),
        ("custom", SPEC, {"critic": "event"}),
        ("madqn", SPEC, {"learning_starts": 10, "batch_size": 8}),
        ("ddpg", BOX, {"learning_starts": 10, "batch_size": 8}),
    ],
)
def test_every_seed_starts_from_the_networks_of_one_seed_of_the_stack(
    algorithm: str, spec: EnvSpec, settings: dict[str, Any]
) -> None:
    parent = _learner(algorithm, spec, (3, 4), **settings)
    hidden_size = 4 if "model" in settings else 1 if algorithm == "ddpg" else 0
    for iteration in (1, 2):
        parent.update(fabricate(spec, 20, 4, seed=iteration, hidden_size=hidden_size), iteration, 0.5)
    state = parent.state_dict()
    child = _learner(algorithm, spec, (7, 8, 9), **settings)
    assert child.start_from(reloaded(state), 1, 2, with_critic=True) == []
    exploration = {"exploration"}  # follows the child's own schedule
    expected = {n: np.split(a, 2)[1] for n, a in parent.acting_parameters().items() if n not in exploration}
    for part in range(3):
        got = {n: np.split(a, 3)[part] for n, a in child.acting_parameters().items() if n not in exploration}
        assert_equal(got, expected)
    started, trained = tensors(child.state_dict()), tensors(state)
    for name in (name for name in trained if "networks " in name or "slow_critic" in name):
        np.testing.assert_array_equal(started[name], np.tile(np.split(trained[name], 2)[1].T, 3).T)
    counts = [array for name, array in started.items() if name.endswith("optimiser counts")]
    assert counts
    assert not np.concatenate(counts).any(), "optimisers start anew"


def test_a_critic_that_does_not_fit_or_is_not_wanted_starts_anew() -> None:
    parent = _learner("mappo", SPEC, (3,))
    parent.update(fabricate(SPEC, 20, 2, seed=1), 1, 0.0)
    for spec, with_critic, notices in ((LARGER_STATE, True, 1), (SPEC, False, 0)):
        child, other = _learner("mappo", spec, (7,)), _learner("mappo", spec, (7,))
        assert len(child.start_from(parent.state_dict(), 0, 1, with_critic)) == notices
        assert_equal(tensors(child.state_dict()["critic"]), tensors(other.state_dict()["critic"]))
        assert_equal(child.acting_parameters(), parent.acting_parameters())


def test_policies_that_were_split_are_taken_over() -> None:
    parent = _learner("ippo", SPEC, (3,), policies="independent", shared_until=0.5)
    for iteration, progress in ((1, 0.0), (2, 0.6)):
        parent.update(fabricate(SPEC, 20, 2, seed=iteration), iteration, progress)
    child = _learner("ippo", SPEC, (7,), policies="independent")
    child.start_from(parent.state_dict(), 0, 1, with_critic=True)
    assert_equal(child.acting_parameters(), parent.acting_parameters())
    with pytest.raises(HeadwayError, match="begins with a shared policy"):
        parent.start_from(parent.state_dict(), 0, 1, with_critic=True)


def test_networks_of_another_algorithm_or_size_are_refused() -> None:
    own, on_policy = _learner("madqn", SPEC, (3,)), _learner("ippo", SPEC, (3,))
    larger = _learner("madqn", SPEC, (3,), model=ModelConfig(hidden=(9,)))
    for parent, with_critic in ((on_policy, False), (larger, True)):
        with pytest.raises(HeadwayError, match="another algorithm or other networks than madqn has"):
            own.start_from(parent.state_dict(), 0, 1, with_critic)


def test_a_critic_of_another_kind_starts_anew() -> None:
    parent, child = _learner("ippo", SPEC, (3,)), _learner("coma", SPEC, (7,))
    assert len(child.start_from(parent.state_dict(), 0, 1, with_critic=True)) == 1


@pytest.mark.parametrize("decay_steps", [None, 500.0])
def test_replay_buffers_are_filled_while_exploration_waits(decay_steps: float | None) -> None:
    """Exploration falls from 1 with the share of training, or its steps, not with the rule's iterations."""
    learner = _learner("madqn", SPEC, (3,), learning_starts=10_000, exploration_decay_steps=decay_steps)
    for iteration in (1, 2, 3):
        metrics = learner.imitate(fabricate(SPEC, 64, 4, seed=iteration), iteration, 3)
    assert metrics["memory/transitions"][0] > 300
    assert learner.acting_parameters()["exploration"].item() == 1.0
    for iteration, progress in ((4, 0.3), (5, 0.4)):
        learner.update(fabricate(SPEC, 64, 4, seed=iteration), iteration, progress)
    # Schedules lag by one iteration: 64 steps of 4 copies are done before the second update.
    expected = MADQNConfig(exploration_decay_steps=decay_steps).exploration(0.4, 64 * 4)
    assert learner.acting_parameters()["exploration"].item() == pytest.approx(expected)
