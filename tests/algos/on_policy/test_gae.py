"""Generalised advantage estimation against its definition."""

from typing import Any

import numpy as np
import pytest
from made_trajectories import naive_advantages
from numpy.typing import NDArray

from headway_algos.on_policy.gae import generalised_advantages, with_teammates_values

Array = NDArray[Any]
Case = tuple[Array, Array, Array, Array, Array, Array]
"""Rewards, values, final values, terminated, truncated, present."""


def _random_case(seed: int, absent: float) -> Case:
    draw = np.random.default_rng(seed)
    shape = (15, 3, 4)
    ended = draw.random(shape) < 0.2
    natural = draw.random(shape) < 0.5
    present = draw.random((16, 3, 4)) >= absent
    rewards, final_values = draw.normal(size=shape), draw.normal(size=shape)
    return (
        rewards, draw.normal(size=(16, 3, 4)), final_values, ended & natural, ended & ~natural, present
    )  # fmt: skip


@pytest.mark.parametrize("absent", [0.0, 0.4])
@pytest.mark.parametrize(("gamma", "gae_lambda"), [(0.9, 0.7), (0.99, 1.0), (0.8, 0.0), (1.0, 1.0)])
def test_equals_the_explicit_sum(absent: float, gamma: float, gae_lambda: float) -> None:
    arrays = _random_case(1, absent)
    result = generalised_advantages(*arrays, gamma, gae_lambda)
    for copy in range(3):
        for agent in range(4):
            one = (array[:, copy, agent] for array in arrays)
            expected = naive_advantages(*one, gamma, gae_lambda)
            np.testing.assert_allclose(result[:, copy, agent], expected, rtol=0, atol=1e-12)


def _one(values: list[float], dtype: type = float) -> Array:
    return np.array(values, dtype)[:, None, None]


def test_a_period_of_absence_is_one_longer_step() -> None:
    """Present at steps 0 and 3 of four: the same as two steps with gamma^3 and discounted rewards."""
    gamma, lam = 0.9, 0.6
    none = np.zeros((4, 1, 1), np.bool_)
    present = np.array([1, 0, 0, 1, 1], np.bool_)[:, None, None]
    values = _one([0.3, np.nan, np.nan, -0.4, 0.8])
    result = generalised_advantages(
        _one([1, 2, 3, 4]), values, np.full((4, 1, 1), np.nan), none, none, present, gamma, lam
    )
    last = 4 + gamma * 0.8 + 0.4
    first = 1 + gamma * 2 + gamma**2 * 3 + gamma**3 * -0.4 - 0.3 + gamma**3 * lam * last
    np.testing.assert_allclose(result[:, 0, 0], [first, 0, 0, last], rtol=0, atol=1e-12)


def test_values_of_absent_steps_are_never_read() -> None:
    rewards, values, final_values, terminated, truncated, present = _random_case(2, 0.5)
    absent = ~present.astype(np.bool_)
    nan_values = np.where(absent, np.nan, values)
    unused = np.where(truncated, final_values, np.nan)
    expected = generalised_advantages(
        rewards, values, final_values, terminated, truncated, present, 0.95, 0.9
    )
    result = generalised_advantages(rewards, nan_values, unused, terminated, truncated, present, 0.95, 0.9)
    np.testing.assert_array_equal(result, expected)
    assert np.isfinite(result).all()
    assert (result[absent[:-1]] == 0).all()


def test_an_agent_absent_at_the_end_gets_its_teammates_value() -> None:
    values = np.array([[1.0, np.nan, 4.0], [np.nan, np.nan, np.nan]])
    present = np.array([[True, False, True], [False] * 3])
    filled, awaiting = with_teammates_values(values, present, ("a",) * 3)
    np.testing.assert_array_equal(filled[0], [1.0, 2.5, 4.0])
    np.testing.assert_array_equal(awaiting, [[True] * 3, [False] * 3])
    assert not present[0, 1]


def test_with_rewards_per_team_an_absent_agent_gets_its_own_teams_value() -> None:
    values = np.array([[1.0, np.nan, 3.0, 8.0, np.nan]])
    present = np.array([[True, False, True, True, False]])
    filled, awaiting = with_teammates_values(values, present, ("a", "a", "a", "b", "c"))
    np.testing.assert_array_equal(filled, [[1.0, 2.0, 3.0, 8.0, 0.0]])
    np.testing.assert_array_equal(awaiting, [[True, True, True, True, False]])
