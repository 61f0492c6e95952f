"""Means per seed, and the advice when training diverges."""

from typing import Any

import numpy as np
import pytest
import torch

from headway_algos.batches.divergence import remedy
from headway_algos.batches.layout import mean_per_replica
from headway_algos.registry import configure


def test_networks_that_took_no_step_do_not_count_in_the_mean() -> None:
    values = torch.tensor([1.0, 3.0, torch.nan, 5.0, torch.nan, torch.nan])
    np.testing.assert_array_equal(mean_per_replica(values, 3), [2.0, 5.0, np.nan])


@pytest.mark.parametrize(
    ("name", "settings", "of_critic", "advice"),
    [
        ("mappo", {}, False, "lower algo.lr or algo.grad_clip"),
        ("mappo", {"grad_clip": None}, False, "lower algo.lr, or bound the gradients by algo.grad_clip"),
        ("mappo", {"critic_lr": 1e-3}, True, "lower algo.critic_lr or algo.grad_clip"),
        ("matrpo", {}, False, "lower algo.lr or algo.kl_bound or algo.grad_clip"),
        ("maacktr", {}, False, "lower algo.lr or algo.kl_bound"),
        ("maacktr", {}, True, "lower algo.critic_lr or algo.critic_kl_bound"),
        ("madqn", {}, False, "lower algo.lr or algo.grad_clip"),
    ],
)
def test_advice_names_keys_in_use(name: str, settings: dict[str, Any], of_critic: bool, advice: str) -> None:
    assert remedy(configure(name, **settings), of_critic) == advice
