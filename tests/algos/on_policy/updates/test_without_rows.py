"""Policies without rows in an update."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from learned import tensors
from numpy.typing import NDArray
from policy_rows import every_space, random_rows, update_of

from headway.contracts import EnvSpec, generator
from headway_algos.components import UPDATES
from headway_algos.config import ModelConfig
from headway_algos.registry import configure

P = 3
SETTINGS: dict[str, dict[str, Any]] = {
    "ppo": {"kl_coeff": 0.2, "kl_target": 1e3, "lr": 1e-2},
    "a2c": {"lr": 1e-2},
    "kfac": {"kfac_momentum": 0.9},
}
"""With these each part of an update's state changes."""


def _state(update: Any) -> dict[str, NDArray[Any]]:  # noqa: ANN401 - one of UPDATES
    return {**tensors(update.state_dict()), **tensors(update.actor.state_dict())}


@every_space
@pytest.mark.parametrize("name", UPDATES)
def test_a_policy_without_rows_stays_unchanged_and_affects_no_other(name: str, spec: EnvSpec) -> None:
    """This includes moments, step counts, averages and coefficients. Metrics of such a policy are NaN."""
    chosen: dict[str, Any] = {"update": name, "precision": "float64", **SETTINGS.get(name, {})}
    config = configure("custom", model=ModelConfig((6,), actor_gain=1.0), **chosen)
    part, whole = (update_of(config, spec, P) for _ in range(2))
    for seed in (1, 2):
        rows, advantages = random_rows(spec, P, 24, seed)
        before = _state(part)
        whole.improve(rows, advantages, [generator(p, "test", seed) for p in range(P)])
        some = replace(rows, selected=rows.selected & ((np.arange(P) != 1) | (seed == 1))[:, None])
        info = part.improve(some, advantages, [generator(p, "test", seed) for p in range(P)])
    after, expected = _state(part), _state(whole)
    for key, array in after.items():
        np.testing.assert_array_equal(array[1], before[key][1], err_msg=key)
        np.testing.assert_allclose(array[[0, 2]], expected[key][[0, 2]], rtol=1e-12, atol=1e-12, err_msg=key)
    assert any((array[0] != before[key][0]).any() for key, array in after.items())
    assert info.pop("kl_coeff", torch.ones(())).isfinite().all()
    assert all(torch.isnan(value).tolist() == [False, True, False] for value in info.values())
    none = replace(rows, selected=np.zeros_like(rows.selected))
    info = part.improve(none, advantages, [generator(p, "test") for p in range(P)])
    for key, array in _state(part).items():
        np.testing.assert_array_equal(array, after[key], err_msg=key)
    assert all(bool(torch.isnan(value).all()) for key, value in info.items() if key != "kl_coeff")
