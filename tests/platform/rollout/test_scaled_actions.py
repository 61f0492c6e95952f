"""Box actions in the units of policies."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from headway.contracts import BatchWrapper, Box, Discrete, EnvSpec, Observations, StepResult
from headway.rollout.plan import RolloutPlan
from headway.rollout.scaled_actions import ScaledActions
from headway.rollout.serial_collector import SerialCollector
from headway_algos.config import AlgoConfig, ModelConfig
from headway_algos.registry import ENTRIES
from headway_envs.toy.tracking import Tracking, TrackingConfig

INF, FLOAT32 = float("inf"), float(np.finfo(np.float32).max)


@pytest.mark.parametrize(
    ("bounds", "seen"),
    [
        ((0.0, 100.0), (-1.0, 1.0)), ((-3.0, 3.0), (-1.0, 1.0)), ((-1.0, 1.0), (-1.0, 1.0)),
        ((2.0, 2.0), (2.0, 2.0)), ((-INF, 4.0), (-INF, 4.0)), ((0.0, INF), (0.0, INF)),
        ((-INF, INF), (-INF, INF)), ((-FLOAT32, FLOAT32), (-FLOAT32, FLOAT32)),
    ],
)  # fmt: skip
def test_policies_act_between_minus_one_and_one_where_both_bounds_are_finite(
    bounds: tuple[float, float], seen: tuple[float, float]
) -> None:
    space = Box((-7.0, bounds[0]), (9.0, bounds[1])).for_policies
    assert (space.low[1], space.high[1]) == seen
    assert (space.low[0], space.high[0]) == (-1.0, 1.0)


def test_discrete_actions_have_no_units() -> None:
    spec = EnvSpec("switch", ("a",), 1, Discrete(3))
    assert spec.for_policies == spec


class Noted:
    """Records the actions that it is given."""

    def __init__(self, space: Box) -> None:
        self.spec, self.num_copies = EnvSpec("noted", ("a",), 1, space), 5
        self.given = np.zeros(0, np.float32)

    def step(self, actions: NDArray[Any]) -> tuple[None, None]:
        self.given = actions
        return None, None


def test_each_component_is_mapped_between_its_bounds() -> None:
    low, high = np.array([0.0, -3.0, 2.0, -INF]), np.array([100.0, 1.0, 2.0, INF])
    env: Any = Noted(Box(tuple(low), tuple(high)))
    actions = np.array([[-1.0], [-0.5], [0.0], [1.0], [1.5]], np.float32)[..., None].repeat(4, axis=2)
    ScaledActions(env, env.spec.for_policies).step(actions)
    assert env.given.dtype == np.float32
    for i in (0, 1):
        within = np.interp(actions[:4, 0, i], [-1, 1], [low[i], high[i]])
        np.testing.assert_allclose(env.given[:4, 0, i], within, rtol=1e-6)
        assert env.given[4, 0, i] > high[i]  # the environment clips
    np.testing.assert_array_equal(env.given[..., 2:], actions[..., 2:])


class Restated(BatchWrapper):
    """`Tracking` with actions stated in other bounds than [-2, 2]."""

    def __init__(self, bounds: tuple[float, float], copies: int) -> None:
        inner = Tracking(TrackingConfig(agents=2, steps=10), copies)
        space = Box((bounds[0],) * 2, (bounds[1],) * 2)
        super().__init__(inner, replace(inner.spec, action_space=space))
        self._bounds = bounds

    def step(self, actions: NDArray[Any]) -> tuple[StepResult, Observations]:
        low, high = self._bounds
        return super().step(((actions.astype(np.float64) - low) / (high - low) * 4 - 2).astype(np.float32))


def _curve(bounds: tuple[float, float], algorithm: str, **settings: object) -> list[float]:
    """Training return of each iteration."""
    entry = ENTRIES[algorithm]
    config = entry.config(model=ModelConfig(hidden=(8,)), precision="float64", **settings)
    assert isinstance(config, AlgoConfig)
    spec = Restated(bounds, 1).spec.for_policies
    policy = entry.acting_policy(config, spec)
    plan = RolloutPlan(Restated, (), bounds, spec, policy, (3,), 4, 40, 4)
    collector, learner = SerialCollector(plan), entry.learner(config, spec, (3,), "cpu")
    collector.begin()
    returns = []
    for iteration in range(1, 6):
        episodes = collector.collect(iteration, learner.acting_parameters())
        returns.append(float(np.mean([float(episode.row["return"]) for episode in episodes])))
        learner.update(collector.trajectory, iteration, 0.0)
    collector.close()
    return returns


@pytest.mark.parametrize(("algorithm", "settings"), [("itrpo", {}), ("mappo", {"critic_actions": "others"})])
def test_curves_do_not_depend_on_the_units_of_actions(algorithm: str, settings: dict[str, Any]) -> None:
    curves = [_curve(bounds, algorithm, **settings) for bounds in ((-1, 1), (0, 100), (-3e-4, 5e-4))]
    assert np.ptp(curves[0]) > 0
    for other in curves[1:]:
        np.testing.assert_allclose(other, curves[0], rtol=1e-3)
