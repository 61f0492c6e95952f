"""Environments with MultiDiscrete actions: masks by choice, random play, learning to a known optimum."""

import math
from functools import partial
from typing import Any

import numpy as np
import pytest
from dials import CHOICES, ENTRY, DialsConfig
from toy_training import mean_return, train

from headway.adapters.conformance import CHECKS, play
from headway.contracts import BatchedEnv, MultiDiscrete, RandomRule
from headway.rollout.episodes import evaluate_rule
from headway_algos.config import ModelConfig
from headway_envs.api import from_batched

STEPS = DialsConfig().steps


def dials(prepared: object, copies: int) -> BatchedEnv:
    return ENTRY.make(ENTRY.prepare(DialsConfig()), copies)


@pytest.mark.parametrize("check", CHECKS)
def test_the_contract_is_kept(check: str) -> None:
    CHECKS[check](partial(dials, None), play(partial(dials, None)))


def test_masks_of_the_choices_follow_one_another() -> None:
    env = dials(None, 3)
    assert env.spec.action_space == MultiDiscrete(CHOICES)
    observed = env.reset(np.arange(3, dtype=np.uint64))
    masks, seen = observed.action_masks, observed.observations
    assert masks is not None
    assert masks.shape == (3, 2, sum(CHOICES))
    assert masks[seen > 0].all()  # targets are allowed
    assert (masks.sum(axis=-1) == sum(CHOICES) - 1).all()
    inner = from_batched(dials, None)
    _, infos = inner.reset(seed=0)
    assert infos["agent_0"]["action_mask"].shape == (sum(CHOICES),)


def test_random_play_draws_allowed_options_uniformly() -> None:
    """One in four is right; the environment refuses those forbidden."""
    rows = evaluate_rule(dials, lambda prepared: RandomRule(), None, 77, 100)
    mean = np.mean([float(row["return"]) for row in rows])
    deviation = math.sqrt(STEPS * 0.25 * 0.75 / 200)  # of the mean over 100 episodes of two agents
    assert abs(mean - STEPS / 4) < 5 * deviation


@pytest.mark.parametrize(
    ("algorithm", "settings", "core"),
    [
        ("ippo", {}, "none"),
        pytest.param("mappo", {"critic_actions": "others"}, "none", marks=pytest.mark.slow),
        ("itrpo", {"kl_bound": 0.1}, "none"),
        pytest.param("maacktr", {"lr": 0.25, "kl_bound": 0.1}, "none", marks=pytest.mark.slow),
        pytest.param("itrpo", {"kl_bound": 0.1}, "gru", marks=pytest.mark.slow),
    ],
)
def test_every_update_learns_both_choices(algorithm: str, settings: dict[str, Any], core: str) -> None:
    """The return is at least 0.95 of the optimum, where random play has a quarter."""
    chosen = {
        "model": ModelConfig(hidden=(16,), core=core, **({"gru_size": 8} if core == "gru" else {})),
        "policies": "shared", "lr": 1e-2,
        "gamma": 0.5, "minibatches": 2 if algorithm.endswith("ppo") else 1, **settings,
    }  # fmt: skip
    assert mean_return(train(dials, None, algorithm, chosen, (8, 32, 12))) > 0.95 * STEPS
