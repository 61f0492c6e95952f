"""The pieces of PPO; whole updates are compared in `test_against_naive`."""

from dataclasses import replace
from math import log

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.distributions import Categorical, kl_divergence

from headway.contracts import Discrete, EnvSpec, generator
from headway_algos.batches.layout import Layout
from headway_algos.batches.policy_batch import PolicyBatch
from headway_algos.config import AlgoConfig, ModelConfig
from headway_algos.grouping import Grouping
from headway_algos.networks.actor import Actor
from headway_algos.networks.distributions import MaskedCategorical
from headway_algos.on_policy.updates.gradient_update import ppo_update
from headway_algos.on_policy.updates.losses import LossRows, PPOLoss
from headway_algos.registry import configure

P, B, D, A = 3, 24, 4, 3
DOUBLE = torch.float64
SPEC = EnvSpec("made", ("only",), D, Discrete(A))
CONFIG = configure(
    "custom",
    model=ModelConfig(hidden=(6,), actor_gain=1.0),
    precision="float64",
    epochs=3,
    minibatches=2,
    lr=1e-2,
)


def test_a_rows_loss_stops_changing_where_the_clip_binds() -> None:
    """Equation 7: growth of the ratio beyond the clip gains nothing, a decrease costs in full."""
    cases = [(1.5, 1.0, 0.0), (1.5, -1.0, -1.5), (0.5, 1.0, 0.5), (0.5, -1.0, 0.0), (1.1, 2.0, 2.2)]
    for ratio, advantage, derivative in cases:
        logits = torch.zeros(1, A, 1, dtype=DOUBLE, requires_grad=True)
        new = MaskedCategorical.of_logits(logits, None)
        actions = torch.zeros(1, 1, dtype=torch.int64)
        old = new.log_prob(actions).detach() - log(ratio)
        loss, info = PPOLoss(clip=0.2, entropy_coeff=0.0)(
            new, LossRows(actions, old, torch.tensor([[advantage]], dtype=DOUBLE))
        )
        (slope,) = torch.autograd.grad(loss.sum(), logits)
        # d log pi(0) / d logit 0 = 1 - 1 / A at equal logits
        assert slope[0, 0, 0].item() == pytest.approx(-derivative * (1 - 1 / A), rel=1e-6)
        assert info["clip_fraction"].item() == (abs(ratio - 1) > 0.2)


def _rows(stack: int, selected: NDArray[np.bool_], seed: int = 2) -> tuple[PolicyBatch, Tensor]:
    random = torch.Generator().manual_seed(seed)
    observations = torch.randn(stack, B, D, generator=random, dtype=DOUBLE)
    actions = torch.randint(A, (stack, B), generator=random)
    log_probs = -np.log(A) + 0.3 * torch.randn(stack, B, generator=random, dtype=DOUBLE)
    advantages = torch.randn(stack, B, generator=random, dtype=DOUBLE)
    return PolicyBatch(observations, None, actions, log_probs, selected), advantages


def _run(
    config: AlgoConfig, kl_coeff: Tensor, selected: NDArray[np.bool_]
) -> tuple[Actor, Actor, PolicyBatch, Tensor, dict[str, Tensor]]:
    """One update: the actor before and after, its batch, the coefficients and the metrics."""
    before, after = (Actor(config.model, SPEC, range(P), 1, DOUBLE) for _ in range(2))
    rows, advantages = _rows(P, selected)
    layout = Layout(Grouping.of("shared", SPEC), P, torch.device("cpu"), DOUBLE)
    update = ppo_update(after, config, layout)
    if update.penalty is not None:
        update.penalty.coefficients = kl_coeff
    info = update.improve(rows, advantages, [generator(p, "test") for p in range(P)])
    return before, after, rows, update.penalty.coefficients if update.penalty else kl_coeff, info


def _mean_kl(before: Actor, after: Actor, rows: PolicyBatch, p: int) -> float:
    with torch.no_grad():
        old, new = (Categorical(logits=actor.network(rows.observations)[p].T) for actor in (before, after))
    kl: Tensor = kl_divergence(old, new)
    return float(kl[torch.from_numpy(rows.selected[p])].mean())


def test_the_kl_coefficient_adapts_per_policy() -> None:
    """x 1.5 if KL > 2 target, x 0.5 if KL < target / 2, else unchanged."""
    selected = np.random.default_rng(3).random((P, B)) < 0.7
    start = torch.tensor([0.2, 0.3, 0.4], dtype=DOUBLE)
    config = replace(CONFIG, kl_coeff=0.2, kl_target=1e-9)
    before, after, rows, _, info = _run(config, start, selected)
    kls = sorted(_mean_kl(before, after, rows, p) for p in range(P))
    for p in range(P):
        assert float(info["kl"][p]) == pytest.approx(_mean_kl(before, after, rows, p), rel=1e-9)
    assert kls[2] > 1.05 * kls[0]
    for target in (kls[0] / 2 * 0.99, kls[1] / 2, kls[2] * 2.02, kls[1] * 2, kls[1]):
        _, _, _, adapted, info = _run(replace(config, kl_target=target), start, selected)
        for p, kl in enumerate(info["kl"].tolist()):
            factor = 1.5 if kl > 2 * target else 0.5 if kl < target / 2 else 1.0
            assert float(adapted[p]) == pytest.approx(factor * float(start[p]), rel=1e-12)


def test_a_policy_without_rows_stays_unchanged_and_affects_no_other() -> None:
    some, none = np.ones((P, B), np.bool_), np.ones((P, B), np.bool_)
    none[1] = False
    start = torch.zeros(P, dtype=DOUBLE)
    before, after, _, _, _ = _run(CONFIG, start, none)
    _, full, _, _, _ = _run(CONFIG, start, some)
    for old, new, whole in zip(before.parameters(), after.parameters(), full.parameters(), strict=True):
        assert torch.equal(new[1], old[1])
        torch.testing.assert_close(new[[0, 2]], whole[[0, 2]], rtol=1e-12, atol=1e-12)


def test_a_policy_without_rows_has_no_kl_and_keeps_its_coefficient() -> None:
    """The divergence of a policy with rows is far below the target, which halves the coefficient."""
    selected = np.ones((P, B), np.bool_)
    selected[1] = False
    config = replace(CONFIG, kl_coeff=0.2, kl_target=1e3)
    _, _, _, adapted, info = _run(config, torch.full((P,), 0.2, dtype=DOUBLE), selected)
    assert adapted.tolist() == pytest.approx([0.1, 0.2, 0.1], rel=1e-12)
    assert torch.isnan(info["kl"]).tolist() == [False, True, False]


def test_an_update_without_any_rows_changes_nothing() -> None:
    before, after, _, _, info = _run(CONFIG, torch.zeros(P, dtype=DOUBLE), np.zeros((P, B), np.bool_))
    for old, new in zip(before.parameters(), after.parameters(), strict=True):
        assert torch.equal(new, old)
    assert all(bool(torch.isnan(value).all()) for value in info.values())
