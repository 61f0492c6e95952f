"""TRPO's step against the natural gradient with an explicit Fisher matrix, one policy after another.

The oracle differentiates torch.distributions' KL divergence twice, solves by LU and searches in a loop.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.distributions import Categorical, Independent, Normal, kl_divergence

from headway.contracts import Box, Discrete, EnvSpec
from headway_algos.batches.layout import Layout
from headway_algos.batches.policy_batch import PolicyBatch
from headway_algos.config import AlgoConfig, ModelConfig
from headway_algos.grouping import Grouping
from headway_algos.networks.actor import Actor
from headway_algos.on_policy.updates.trpo import TRPO
from headway_algos.optim.fisher import from_vector, to_vector
from headway_algos.registry import configure

P, B, D, A = 4, 30, 3, 3
DOUBLE = torch.float64
DISCRETE = EnvSpec("made", ("only",), D, Discrete(A), has_action_mask=True)
BOX = EnvSpec("made", ("only",), D, Box((-1.0,) * A, (1.0,) * A))
CONFIG = configure(
    "custom",
    update="trpo",
    model=ModelConfig(hidden=(4,), actor_gain=1.0),
    precision="float64",
    piece_samples=32,
    kl_bound=1e-3,
    entropy_coeff=0.2,
    cg_iterations=60,
)
every_space = pytest.mark.parametrize("spec", [DISCRETE, BOX], ids=["discrete", "box"])


def _update(spec: EnvSpec, config: AlgoConfig = CONFIG, stack: int = P) -> TRPO:
    layout = Layout(Grouping.of("shared", spec), stack, torch.device("cpu"), DOUBLE)
    return TRPO(Actor(config.model, spec, range(stack), 1, DOUBLE), config, layout)


def _rows(spec: EnvSpec, actor: Actor, seed: int = 1) -> tuple[PolicyBatch, Tensor]:
    """Actions sampled from the policies; some rows are not selected, and the last policy has only a few."""
    random = torch.Generator().manual_seed(seed)
    stack = len(actor.network.weights[0])
    observations = torch.randn(stack, B, D, generator=random, dtype=DOUBLE)
    selected = (torch.rand(stack, B, generator=random) < 0.8).numpy()
    selected[-1, 4:] = False
    masks = None
    if spec is DISCRETE:
        masks = torch.rand(stack, B, A, generator=random) < 0.8
        masks[..., 1] |= ~masks.any(-1)
    with torch.no_grad():
        distribution = actor(observations, masks)
        if spec is DISCRETE:
            chances = distribution.log_probs.exp().transpose(1, 2).reshape(-1, A)
            actions = torch.multinomial(chances, 1, generator=random).reshape(stack, B)
        else:
            noise = torch.randn(stack, B, A, generator=random, dtype=DOUBLE)
            actions = distribution.mean.transpose(1, 2) + 0.6 * noise
        log_probs = distribution.log_prob(actions)
    advantages = torch.randn(stack, B, generator=random, dtype=DOUBLE)
    return PolicyBatch(observations, masks, actions, log_probs, selected), advantages


@dataclass
class Found:
    """Result of the oracle for one policy."""

    old: Tensor
    """(V,)"""
    new: Tensor
    size: float
    kl: float
    whole_step_kl: float


class Oracle:
    """One policy, with its parameters in one vector."""

    def __init__(
        self, config: AlgoConfig, actor: Actor, rows: PolicyBatch, advantages: Tensor, p: int
    ) -> None:
        self.config = config
        self.actor = actor.narrow(torch.tensor([p]))
        chosen = np.flatnonzero(rows.selected[p])
        self.observations = rows.observations[p, chosen]
        self.masks = None if rows.masks is None else rows.masks[p, chosen]
        self.actions, self.behaviour = rows.actions[p, chosen], rows.log_probs[p, chosen]
        self.advantages = advantages[p, chosen]
        self.start = to_vector(parameter.detach() for parameter in self.actor.learnable)[0]
        self.old = self._distribution(self.start)

    def _distribution(self, theta: Tensor, every: int = 1) -> Any:  # noqa: ANN401 - torch leaves it untyped
        parts = from_vector(theta[None], self.actor.learnable)
        log_std = parts.pop(0) if self.actor.log_std is not None else None
        weight_1, weight_2, bias_1, bias_2 = (part[0] for part in parts)
        hidden = torch.tanh(self.observations[::every] @ weight_1.T + bias_1[:, 0])
        outputs = hidden @ weight_2.T + bias_2[:, 0]
        if log_std is not None:
            return Independent(Normal(outputs, log_std[0, :, 0].exp().expand_as(outputs)), 1)
        assert self.masks is not None
        return Categorical(logits=outputs.masked_fill(~self.masks[::every], -400.0))

    def surrogate(self, theta: Tensor) -> Tensor:
        distribution = self._distribution(theta)
        ratio = (distribution.log_prob(self.actions) - self.behaviour).exp()
        result: Tensor = (ratio * self.advantages + self.config.entropy_coeff * distribution.entropy()).mean()
        return result

    def kl(self, theta: Tensor, every: int = 1) -> Tensor:
        result: Tensor = kl_divergence(
            self._distribution(self.start, every), self._distribution(theta, every)
        )
        return result.mean()

    def find(self, bound: float, every: int = 1) -> Found:
        theta = self.start.clone().requires_grad_()
        (gradient,) = torch.autograd.grad(self.surrogate(theta), theta)
        fisher = torch.autograd.functional.hessian(lambda theta: self.kl(theta, every), self.start)
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
def test_the_step_is_the_natural_gradients_within_its_bound(spec: EnvSpec) -> None:
    update = _update(spec)
    rows, advantages = _rows(spec, update.actor)
    found = [Oracle(CONFIG, update.actor, rows, advantages, p).find(1e-3) for p in range(P)]
    info = update.improve(rows, advantages, [])
    after = to_vector(update.actor.learnable).detach()
    for p in range(P):
        assert found[p].size == 1
        torch.testing.assert_close(after[p], found[p].new, rtol=1e-9, atol=1e-9)
        assert float(info["kl"][p]) == pytest.approx(found[p].kl, rel=1e-8)
        assert 0 < found[p].kl <= 1e-3
        assert float(info["accepted_step"][p]) == 1


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


def test_the_fisher_information_of_a_share_of_the_rows() -> None:
    config = replace(CONFIG, fisher_share=0.5)
    update = _update(DISCRETE, config)
    rows, advantages = _rows(DISCRETE, update.actor)
    found = [Oracle(config, update.actor, rows, advantages, p).find(1e-3, every=2) for p in range(P)]
    update.improve(rows, advantages, [])
    for p, theta in enumerate(to_vector(update.actor.learnable).detach()):
        torch.testing.assert_close(theta, found[p].new, rtol=1e-9, atol=1e-9)


@every_space
def test_without_a_gradient_nothing_changes(spec: EnvSpec) -> None:
    """The policy has neither advantages nor an entropy bonus, or has no rows and is beside one that is
    trained."""
    config = replace(CONFIG, entropy_coeff=0.0)
    update = _update(spec, config)
    rows, advantages = _rows(spec, update.actor)
    advantages[0] = 0
    rows.selected[1] = False
    before = to_vector(parameter.detach().clone() for parameter in update.actor.learnable)
    info = update.improve(rows, advantages, [])
    after = to_vector(update.actor.learnable).detach()
    assert [bool(torch.equal(after[p], before[p])) for p in range(P)] == [True, True, False, False]
    assert all(torch.isnan(value).tolist() == [False, True, False, False] for value in info.values())
    rows.selected[:] = False
    info = update.improve(rows, advantages, [])
    assert torch.equal(to_vector(update.actor.learnable).detach(), after)
    assert all(bool(torch.isnan(value).all()) for value in info.values())
