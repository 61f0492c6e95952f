"""TRPO's step against the natural gradient with an explicit Fisher matrix, one policy after another.

The oracle differentiates torch.distributions' KL divergence twice, solves by LU and searches in a loop.
"""

from dataclasses import dataclass, replace

import pytest
import torch
from policy_rows import BOX, DISCRETE, DOUBLE, A, OnePolicy, every_space, random_rows, update_of
from torch import Tensor

from headway.contracts import EnvSpec
from headway_algos.batches.policy_batch import PolicyBatch
from headway_algos.config import AlgoConfig, ModelConfig
from headway_algos.networks.actor import Actor
from headway_algos.on_policy.updates.trpo import TRPO
from headway_algos.optim.fisher import to_vector
from headway_algos.registry import configure

P, B = 4, 30
CONFIG = configure(
    "custom", update="trpo", model=ModelConfig(hidden=(4,), actor_gain=1.0), precision="float64",
    piece_samples=32, kl_bound=1e-3, entropy_coeff=0.2, cg_iterations=60,
)  # fmt: skip


def _update(spec: EnvSpec, config: AlgoConfig = CONFIG, stack: int = P) -> TRPO:
    update = update_of(config, spec, stack)
    assert isinstance(update, TRPO)
    return update


def _rows(spec: EnvSpec, actor: Actor, seed: int = 1) -> tuple[PolicyBatch, Tensor]:
    """Actions sampled from the policies."""
    rows, advantages = random_rows(spec, len(actor.network.weights[0]), B, seed)
    random = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        distribution = actor(rows.observations, rows.masks)
        if spec is DISCRETE:
            chances = distribution.log_probs.exp().transpose(1, 2).reshape(-1, A)
            actions = torch.multinomial(chances, 1, generator=random).reshape(rows.actions.shape)
        else:
            actions = distribution.mean.transpose(1, 2) + 0.6 * rows.actions
        return replace(rows, actions=actions, log_probs=distribution.log_prob(actions)), advantages


@dataclass
class Found:
    """Result of the oracle for one policy."""

    old: Tensor
    """(V,)"""
    new: Tensor
    size: float
    kl: float
    whole_step_kl: float


class Oracle(OnePolicy):
    """One policy's step."""

    def __init__(
        self, config: AlgoConfig, actor: Actor, rows: PolicyBatch, advantages: Tensor, p: int
    ) -> None:
        super().__init__(actor, rows, advantages, p)
        self.config = config

    def surrogate(self, theta: Tensor) -> Tensor:
        distribution = self.distribution(theta)
        ratio = (distribution.log_prob(self.actions) - self.behaviour).exp()
        result: Tensor = (ratio * self.advantages + self.config.entropy_coeff * distribution.entropy()).mean()
        return result

    def find(self, bound: float, every: int = 1) -> Found:
        theta = self.start.clone().requires_grad_()
        (gradient,) = torch.autograd.grad(self.surrogate(theta), theta)
        fisher = self.fisher(every)
        damped = fisher + self.config.cg_damping * torch.eye(len(gradient), dtype=DOUBLE)
        direction = torch.linalg.solve(damped, gradient)
        step = (2 * bound / (direction @ damped @ direction)).sqrt() * direction
        whole = float(self.kl(self.start + step))
        for halvings in range(self.config.line_search_steps + 1):
            size = 0.5**halvings
            theta = self.start + size * step
            risen = self.surrogate(theta) - self.surrogate(self.start)
            if self.kl(theta) <= bound and risen >= self.config.accept_ratio * size * (gradient @ step):
                return Found(self.start, theta, size, float(self.kl(theta)), whole)
        return Found(self.start, self.start, 0.0, 0.0, whole)


@every_space
@pytest.mark.parametrize("every", [1, 2])
def test_the_step_is_the_natural_gradients_within_its_bound(spec: EnvSpec, every: int) -> None:
    """The Fisher information is of all rows, or of a share of them."""
    config = replace(CONFIG, fisher_share=1 / every)
    update = _update(spec, config)
    rows, advantages = _rows(spec, update.actor)
    found = [Oracle(config, update.actor, rows, advantages, p).find(1e-3, every) for p in range(P)]
    info = update.improve(rows, advantages, [])
    after = to_vector(update.actor.learnable).detach()
    for p in range(P):
        torch.testing.assert_close(after[p], found[p].new, rtol=1e-9, atol=1e-9)
        assert float(info["kl"][p]) == pytest.approx(found[p].kl, rel=1e-8)
        assert 0 < found[p].kl <= 1e-3
        assert float(info["accepted_step"][p]) == found[p].size


@every_space
def test_the_line_search_is_per_policy(spec: EnvSpec) -> None:
    """In one stack, some policies accept at once, some after halvings, and some never, which stay unchanged
    bit for bit."""
    stack = 10
    config = replace(CONFIG, kl_bound=0.6, accept_ratio=0.7, line_search_steps=1, entropy_coeff=0.0)
    update = _update(spec, config, stack)
    rows, advantages = _rows(spec, update.actor, seed=3)
    found = [Oracle(config, update.actor, rows, advantages, p).find(0.6) for p in range(stack)]
    before = to_vector(parameter.detach().clone() for parameter in update.actor.learnable)
    info = update.improve(rows, advantages, [])
    after = to_vector(update.actor.learnable).detach()
    sizes = [one.size for one in found]
    assert set(sizes) == {1.0, 0.5, 0.0}
    assert info["accepted_step"].tolist() == sizes
    for p, one in enumerate(found):
        assert torch.equal(after[p], before[p]) == (one.size == 0)
        torch.testing.assert_close(after[p], one.new, rtol=1e-8, atol=1e-8)
        assert float(info["kl"][p]) == pytest.approx(one.kl, rel=1e-7, abs=1e-12)
        assert float(info["kl"][p]) <= 0.6


def test_a_step_beyond_the_bound_is_halved_even_if_it_improves() -> None:
    """`accept_ratio` is 0, and the bound is so wide that the quadratic estimate of the KL divergence
    fails."""
    config = replace(CONFIG, kl_bound=0.5, accept_ratio=0.0)
    update = _update(BOX, config, 10)
    rows, advantages = _rows(BOX, update.actor, seed=3)
    found = [Oracle(config, update.actor, rows, advantages, p).find(0.5) for p in range(10)]
    assert any(one.whole_step_kl > 0.5 and one.size > 0 for one in found)
    assert update.improve(rows, advantages, [])["accepted_step"].tolist() == [one.size for one in found]


@every_space
def test_without_a_gradient_nothing_changes(spec: EnvSpec) -> None:
    """There are neither advantages nor an entropy bonus."""
    update = _update(spec, replace(CONFIG, entropy_coeff=0.0))
    rows, advantages = _rows(spec, update.actor)
    advantages[0] = 0
    before = to_vector(parameter.detach().clone() for parameter in update.actor.learnable)
    update.improve(rows, advantages, [])
    after = to_vector(update.actor.learnable).detach()
    assert [bool(torch.equal(after[p], before[p])) for p in range(P)] == [True, False, False, False]
