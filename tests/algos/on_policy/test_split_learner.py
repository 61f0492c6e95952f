"""A shared policy that is split into separate ones during training."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from made_trajectories import fabricate
from numpy.typing import NDArray

from headway.contracts import Discrete, EnvSpec
from headway_algos.config import AlgoConfig, ModelConfig
from headway_algos.on_policy.learner import OnPolicyLearner
from headway_algos.on_policy.split_learner import SplitLearner
from headway_algos.registry import configure

SPEC = EnvSpec(
    "made", tuple("abcd"), 3, Discrete(3), state_size=5, groups=tuple("xyxx"), has_action_mask=True
)
TEAM = replace(SPEC, shared_reward=True)
MODEL = ModelConfig(hidden=(8,), actor_gain=0.5)
SETTINGS: dict[str, Any] = {"policies": "independent", "model": MODEL, "precision": "float64"}
CASES: dict[str, tuple[AlgoConfig, EnvSpec]] = {
    "ippo": (configure("ippo", **SETTINGS, minibatches=2), SPEC),
    "mappo of own rewards, groups": (configure("mappo", **{**SETTINGS, "policies": "groups"}), SPEC),
    "coma of a team": (configure("coma", **SETTINGS), TEAM),
}
SEEDS = (3, 4)


def _same(one: dict[str, NDArray[np.float64]], other: dict[str, NDArray[np.float64]]) -> bool:
    return all(np.array_equal(one[name], other[name]) for name in one)


@pytest.mark.parametrize("name", CASES)
def test_policies_equal_the_shared_one_until_the_split_and_start_from_it(name: str) -> None:
    config, spec = CASES[name]
    parting = SplitLearner(replace(config, shared_until=0.5), spec, SEEDS, "cpu")
    shared = OnPolicyLearner(replace(config, policies="shared", agent_id=False), spec, SEEDS, "cpu")
    policies = parting.policies
    for iteration, progress in enumerate((0.0, 0.25, 0.49)):
        trajectory = fabricate(spec, 20, 2 * len(SEEDS), seed=iteration)
        parting.update(trajectory, iteration, progress)
        shared.update(trajectory, iteration, progress)
        expected = {
            key: np.repeat(array, policies, axis=0) for key, array in shared.acting_parameters().items()
        }
        assert _same(parting.acting_parameters(), expected)
    last = parting.acting_parameters()
    parting.update(fabricate(spec, 20, 2 * len(SEEDS), seed=9), 3, 0.5)
    weights = parting.acting_parameters()["weight_0"]
    assert not np.array_equal(weights[0], weights[1]), "policies of their own learn from their own rows"
    assert np.abs(weights - last["weight_0"]).max() < 0.5, "they go on from the shared policy"
    metrics = parting.update(fabricate(spec, 20, 2 * len(SEEDS), seed=10), 4, 0.75)
    assert all(value.shape == (len(SEEDS),) for value in metrics.values())


def test_the_optimiser_keeps_the_moments_of_the_shared_policy() -> None:
    config, spec = CASES["ippo"]
    learner = SplitLearner(replace(config, shared_until=0.5), spec, SEEDS, "cpu")
    learner.update(fabricate(spec, 20, 2 * len(SEEDS), seed=0), 0, 0.0)
    steps = learner.shared.state_dict()["policy_update"]["optimiser"]["counts"]
    learner.update(fabricate(spec, 20, 2 * len(SEEDS), seed=1), 1, 0.5)
    after = learner.separate.state_dict()["policy_update"]["optimiser"]["counts"]
    assert (after == 2 * steps[0]).all()
    assert len(after) == 4 * len(steps)


@pytest.mark.parametrize("update", ["ppo", "a2c", "trpo"])
def test_steps_are_smaller_after_the_split(update: str) -> None:
    """A hundredth of the learning rate: steps of Adam and TRPO are proportional to it."""

    def step_apart(apart_lr: float) -> float:
        config = configure(
            "custom", update=update, model=MODEL, precision="float64", epochs=1, minibatches=1,
            shared_until=0.5, apart_lr=apart_lr, normalise_observations=False,
        )  # fmt: skip
        learner = SplitLearner(config, SPEC, SEEDS, "cpu")
        learner.update(fabricate(SPEC, 20, 2 * len(SEEDS), seed=0), 0, 0.0)
        before = learner.acting_parameters()
        learner.update(fabricate(SPEC, 20, 2 * len(SEEDS), seed=1), 1, 0.5)
        after = learner.acting_parameters()
        return float(np.mean([np.abs(after[name] - before[name]).mean() for name in after]))

    ratio = step_apart(0.01) / step_apart(1.0)
    assert 0.003 < ratio < 0.03, ratio


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"apart_lr": 0.5}, "apart_lr applies after shared_until: set shared_until"),
        ({"apart_lr": 0.0, "shared_until": 0.5}, "apart_lr must be above 0"),
        ({"shared_until": 1.0}, r"shared_until must lie in \[0, 1\)"),
        ({"shared_until": 0.5, "policies": "shared"}, "shared_until must be 0 with policies: shared"),
    ],
)
def test_impossible_splits_are_refused(changes: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        configure("custom", **changes)  # type: ignore[arg-type]  # as from YAML
