"""The pieces of PPO; whole updates are compared in `test_against_naive`."""

from dataclasses import replace
from math import log

import pytest
import torch
from policy_rows import DOUBLE, A, random_rows, update_of
from torch import Tensor
from torch.distributions import Categorical, kl_divergence

from headway.contracts import Discrete, EnvSpec, generator
from headway_algos.batches.policy_batch import PolicyBatch
from headway_algos.config import AlgoConfig, ModelConfig
from headway_algos.networks.actor import Actor
from headway_algos.networks.distributions import MaskedCategorical
from headway_algos.on_policy.updates.losses import LossRows, PPOLoss
from headway_algos.registry import configure

P = 3
SPEC = EnvSpec("made", ("only",), 3, Discrete(A))
CONFIG = configure(
    "custom", model=ModelConfig(hidden=(6,), actor_gain=1.0), precision="float64", epochs=3, minibatches=2,
    lr=1e-2, kl_coeff=0.2,
)  # fmt: skip


def test_a_rows_loss_stops_changing_where_the_clip_binds() -> None:
    """Equation 7: growth of the ratio beyond the clip gains nothing, a decrease costs in full."""
    cases = [(1.5, 1.0, 0.0), (1.5, -1.0, -1.5), (0.5, 1.0, 0.5), (0.5, -1.0, 0.0), (1.1, 2.0, 2.2)]
    for ratio, advantage, derivative in cases:
        logits = torch.zeros(1, A, 1, dtype=DOUBLE, requires_grad=True)
        new = MaskedCategorical.of_logits(logits, None)
        actions = torch.zeros(1, 1, dtype=torch.int64)
        old = new.log_prob(actions).detach() - log(ratio)
        rows = LossRows(actions, old, torch.tensor([[advantage]], dtype=DOUBLE))
        loss, info = PPOLoss(clip=0.2, entropy_coeff=0.0)(new, rows)
        (slope,) = torch.autograd.grad(loss.sum(), logits)
        # d log pi(0) / d logit 0 = 1 - 1 / A at equal logits
        assert slope[0, 0, 0].item() == pytest.approx(-derivative * (1 - 1 / A), rel=1e-6)
        assert info["clip_fraction"].item() == (abs(ratio - 1) > 0.2)


def _run(config: AlgoConfig, start: Tensor) -> tuple[Actor, Actor, PolicyBatch, Tensor, dict[str, Tensor]]:
    """One update: the actor before and after, its batch, the coefficients and the metrics."""
    before, update = Actor(config.model, SPEC, range(P), 1, DOUBLE), update_of(config, SPEC, P)
    rows, advantages = random_rows(SPEC, P, 24)
    update.penalty.coefficients = start
    info = update.improve(rows, advantages, [generator(p, "test") for p in range(P)])
    return before, update.actor, rows, update.penalty.coefficients, info


def _mean_kl(before: Actor, after: Actor, rows: PolicyBatch, p: int) -> float:
    with torch.no_grad():
        old, new = (Categorical(logits=actor.network(rows.observations)[p].T) for actor in (before, after))
    kl: Tensor = kl_divergence(old, new)
    return float(kl[torch.from_numpy(rows.selected[p])].mean())


def test_the_kl_coefficient_adapts_per_policy() -> None:
    """x 1.5 if KL > 2 target, x 0.5 if KL < target / 2, else unchanged."""
    start = torch.tensor([0.2, 0.3, 0.4], dtype=DOUBLE)
    before, after, rows, _, info = _run(replace(CONFIG, kl_target=1e-9), start)
    kls = sorted(_mean_kl(before, after, rows, p) for p in range(P))
    for p in range(P):
        assert float(info["kl"][p]) == pytest.approx(_mean_kl(before, after, rows, p), rel=1e-9)
    assert kls[2] > 1.05 * kls[0]
    for target in (kls[0] / 2 * 0.99, kls[1] / 2, kls[2] * 2.02, kls[1] * 2, kls[1]):
        _, _, _, adapted, info = _run(replace(CONFIG, kl_target=target), start)
        for p, kl in enumerate(info["kl"].tolist()):
            factor = 1.5 if kl > 2 * target else 0.5 if kl < target / 2 else 1.0
            assert float(adapted[p]) == pytest.approx(factor * float(start[p]), rel=1e-12)
