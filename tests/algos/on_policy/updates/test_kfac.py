"""K-FAC's steps: the natural gradient where its factors are exact, a naive loop elsewhere, within bounds."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from policy_rows import (
    BOX,
    DISCRETE,
    DOUBLE,
    A,
    D,
    OnePolicy,
    damped_kronecker,
    every_space,
    random_rows,
    update_of,
)
from torch import Tensor, nn
from torch.distributions import Categorical, Independent, Normal

from headway.contracts import EnvSpec, HeadwayError, generator
from headway_algos.batches.layout import Layout
from headway_algos.batches.policy_batch import PolicyBatch
from headway_algos.config import AlgoConfig, ModelConfig
from headway_algos.grouping import Grouping
from headway_algos.networks.actor import Actor
from headway_algos.networks.distributions import DiagonalGaussian, MaskedCategorical
from headway_algos.networks.mlp import StackedMLP
from headway_algos.on_policy.updates.kfac import KFAC
from headway_algos.optim.fisher import to_vector
from headway_algos.optim.kfac_regression import KFACRegression
from headway_algos.registry import configure

P, B = 3, 24
CONFIG = configure(
    "custom", update="kfac", model=ModelConfig(hidden=(5, 4), actor_gain=1.0), precision="float64",
    piece_samples=30, lr=0.5, kl_bound=1e-3, entropy_coeff=0.2,
)  # fmt: skip


def _update(spec: EnvSpec, config: AlgoConfig = CONFIG) -> KFAC:
    update = update_of(config, spec, P)
    assert isinstance(update, KFAC)
    return update


def _rows(spec: EnvSpec, seed: int = 1) -> tuple[PolicyBatch, Tensor]:
    return random_rows(spec, P, B, seed)


def _generators(iteration: int) -> list[np.random.Generator]:
    return [generator(p, "test", iteration) for p in range(P)]


class Chosen(np.random.Generator):
    """A generator that returns preset noise."""

    def __init__(self, noise: NDArray[np.float64]) -> None:
        super().__init__(np.random.Philox(0))
        self.noise = noise

    def random(self, *args: Any, **kwargs: Any) -> Any:  # noqa: ANN401 - numpy's own
        return self.noise

    def standard_normal(self, *args: Any, **kwargs: Any) -> Any:  # noqa: ANN401 - numpy's own
        return self.noise


class Alone(OnePolicy):
    def gradient(self, entropy_coeff: float) -> Tensor:
        theta = self.start.clone().requires_grad_()
        now = self.distribution(theta)
        objective = now.log_prob(self.actions) * self.advantages + entropy_coeff * now.entropy()
        result: Tensor = torch.autograd.grad(objective.mean(), theta)[0]
        return result


def _moved(
    update: KFAC, rows: PolicyBatch, advantages: Tensor, generators: Sequence[np.random.Generator]
) -> tuple[Tensor, dict[str, Tensor]]:
    """Changes of the parameters, (P, V), and the metrics."""
    before = to_vector(parameter.detach().clone() for parameter in update.actor.learnable)
    info = update.improve(rows, advantages, generators)
    return to_vector(update.actor.learnable).detach() - before, info


def test_the_step_is_the_natural_gradient_for_a_linear_gaussian_policy() -> None:
    """Scores do not depend on inputs there, so the Fisher information is exactly a Kronecker product. The
    noise is plus and minus sqrt(A) along each axis, with the second moments of the distribution."""
    config = replace(CONFIG, model=ModelConfig(()), kfac_damping=1e-16, lr=0.1, kl_bound=1e9)
    update = _update(BOX, config)
    rows, advantages = _rows(BOX)
    rows.selected[:] = True
    axes = np.concatenate([np.eye(A), -np.eye(A)]) * A**0.5
    found = [Alone(update.actor, rows, advantages, p) for p in range(P)]
    moved, info = _moved(update, rows, advantages, [Chosen(np.tile(axes, (B // 6, 1)))] * P)
    for p, one in enumerate(found):
        natural = torch.linalg.solve(one.fisher(), one.gradient(config.entropy_coeff))
        torch.testing.assert_close(moved[p], 0.1 * natural, rtol=1e-6, atol=1e-9)
        assert float(info["step"][p]) == pytest.approx(0.1, rel=1e-12)


def test_the_step_is_the_natural_gradient_for_a_categorical_policy_with_constant_input() -> None:
    """Evenly spaced uniforms sample probabilities of 1/2, 1/4, 1/4 exactly."""
    config = replace(CONFIG, model=ModelConfig(()), kfac_damping=1e-9, lr=0.1, kl_bound=1e9)
    update = _update(DISCRETE, config)
    rows, advantages = _rows(DISCRETE)
    rows.selected[:] = True
    rows = replace(rows, observations=rows.observations[:, :1].expand(-1, B, -1).contiguous(), masks=None)
    with torch.no_grad():
        logits = torch.tensor([0.5, 0.25, 0.25], dtype=DOUBLE).log()
        update.actor.network.biases[0].zero_()
        seen = update.actor.network(rows.observations[:, :1])
        update.actor.network.biases[0].copy_(logits[:, None] - seen)
    found = [Alone(update.actor, rows, advantages, p) for p in range(P)]
    moved, _ = _moved(update, rows, advantages, [Chosen((np.arange(B) + 0.5) / B)] * P)
    for p, one in enumerate(found):
        # Logits that all rise alike change nothing: of all natural gradients the shortest.
        natural = torch.linalg.pinv(one.fisher(), rtol=1e-9) @ one.gradient(config.entropy_coeff)
        torch.testing.assert_close(moved[p], 0.1 * natural, rtol=1e-3, atol=1e-6)


class Naive:
    """One policy's K-FAC with whole matrices, loops over rows and automatic differentiation."""

    def __init__(self, config: AlgoConfig, actor: Actor, p: int) -> None:
        self.config, self.p = config, p
        self.weights = [nn.Parameter(w[p].detach().clone()) for w in actor.network.weights]
        self.biases = [nn.Parameter(b[p, :, 0].detach().clone()) for b in actor.network.biases]
        self.log_std = (
            None if actor.log_std is None else nn.Parameter(actor.log_std[p, :, 0].detach().clone())
        )
        self.factors: list[list[Tensor]] = []
        self.inverses: list[Tensor] = []
        self.direction = torch.zeros(())
        self.steps = 0

    def _run(self, x: Tensor) -> tuple[list[Tensor], Tensor]:
        inputs = []
        for i, (w, b) in enumerate(zip(self.weights, self.biases, strict=True)):
            inputs.append(torch.cat([x.detach(), torch.ones(1, dtype=DOUBLE)]))
            x = w @ x + b
            x = torch.tanh(x) if i < len(self.weights) - 1 else x
        return inputs, x

    def _distribution(self, outputs: Tensor, mask: Tensor | None) -> Any:  # noqa: ANN401 - torch leaves it untyped
        if self.log_std is not None:
            return Independent(Normal(outputs, self.log_std.exp()), 1)
        assert mask is not None
        return Categorical(logits=outputs.masked_fill(~mask, -400.0))

    def _columns(
        self, of_weights: Sequence[Tensor], of_biases: Sequence[Tensor], own: Tensor | None
    ) -> Tensor:
        """A vector: the log standard deviation, then each layer's matrix column by column."""
        layers = [
            torch.cat([w, b[:, None]], dim=1).T.reshape(-1)
            for w, b in zip(of_weights, of_biases, strict=True)
        ]
        return torch.cat([*([] if own is None else [own]), *layers])

    def improve(
        self, rows: PolicyBatch, advantages: Tensor, random: np.random.Generator
    ) -> tuple[float, float]:
        """Returns eta and the expected divergence."""
        config, chosen = self.config, np.flatnonzero(rows.selected[self.p])
        shape = (len(chosen),) if self.log_std is None else (len(chosen), A)
        noise = random.random(shape) if self.log_std is None else random.standard_normal(shape)
        sums = [[torch.zeros(n, n, dtype=DOUBLE) for n in (w.shape[1] + 1, len(w))] for w in self.weights]
        own = [] if self.log_std is None else [self.log_std]
        parameters = [*self.weights, *self.biases, *own]
        total = torch.zeros((), dtype=DOUBLE)
        fisher: Tensor | None = None
        for place, b in enumerate(chosen.tolist()):
            inputs, outputs = self._run(rows.observations[self.p, b])
            mask = None if rows.masks is None else rows.masks[self.p, b]
            now = self._distribution(outputs, mask)
            if self.log_std is None:
                below = np.cumsum(now.probs.detach().numpy())
                drawn = torch.tensor(int(np.searchsorted(below, noise[place], side="right")))
                chances = now.probs.detach()
                of_outputs = torch.diag(chances) - torch.outer(chances, chances)
            else:
                spread = self.log_std.detach().exp()
                drawn = outputs.detach() + spread * torch.from_numpy(np.atleast_1d(noise[place]))
                of_outputs = torch.diag(spread**-2)
            signals = torch.autograd.grad(now.log_prob(drawn), self.biases, retain_graph=True)
            for (one, other), a, g in zip(sums, inputs, signals, strict=True):
                one += torch.outer(a, a) / len(chosen)
                other += torch.outer(g, g) / len(chosen)
            slopes = []
            for output in outputs:
                parts = torch.autograd.grad(output, parameters, retain_graph=True, materialize_grads=True)
                layers = len(self.weights)
                extra = parts[-1] if own else None
                slopes.append(self._columns(parts[:layers], parts[layers : 2 * layers], extra))
            jacobian = torch.stack(slopes)
            part = jacobian.T @ of_outputs @ jacobian / len(chosen)
            fisher = part if fisher is None else fisher + part
            taken = rows.actions[self.p, b]
            total = total + now.log_prob(taken) * advantages[self.p, b] + config.entropy_coeff * now.entropy()
        grads = torch.autograd.grad(total / len(chosen), parameters)
        layers = len(self.weights)
        gradient = self._columns(grads[:layers], grads[layers : 2 * layers], grads[-1] if own else None)
        self._average(sums)
        solution = torch.linalg.solve(self._block(self.inverses), gradient)
        mu = config.kfac_momentum
        self.direction = mu * self.direction + (1 - mu) * solution
        curvature = self._block([damped_kronecker(*pair, self.config.kfac_damping) for pair in self.factors])
        if config.kfac_length == "exact":
            assert fisher is not None
            if own:
                fisher[:A, :A] += 2 * torch.eye(A, dtype=DOUBLE)
            curvature = fisher + config.kfac_damping * torch.eye(len(fisher), dtype=DOUBLE)
        quadratic = self.direction @ curvature @ self.direction
        eta = min(config.lr, float((2 * config.kl_bound / quadratic).sqrt()))
        self._go(eta * self.direction)
        return eta, 0.5 * eta**2 * float(quadratic)

    def _average(self, sums: list[list[Tensor]]) -> None:
        self.steps += 1
        kept = min(1 - 1 / self.steps, self.config.kfac_decay)
        old = self.factors or sums
        self.factors = [
            [kept * x + (1 - kept) * y for x, y in zip(one, other, strict=True)]
            for one, other in zip(old, sums, strict=True)
        ]
        if (self.steps - 1) % self.config.kfac_every == 0:
            self.inverses = [damped_kronecker(*pair, self.config.kfac_damping) for pair in self.factors]

    def _block(self, layers: list[Tensor]) -> Tensor:
        own = [] if self.log_std is None else [(2 + self.config.kfac_damping) * torch.eye(A, dtype=DOUBLE)]
        return torch.block_diag(*own, *layers)

    def _go(self, change: Tensor) -> None:
        with torch.no_grad():
            if self.log_std is not None:
                self.log_std += change[:A]
                change = change[A:]
            for w, b in zip(self.weights, self.biases, strict=True):
                count = w.numel() + len(b)
                matrix, change = change[:count].reshape(w.shape[1] + 1, len(w)).T, change[count:]
                w += matrix[:, :-1]
                b += matrix[:, -1]


MOMENTUM = {"kfac_momentum": 0.4, "kfac_every": 2, "kfac_decay": 0.3}


@pytest.mark.parametrize(
    ("spec", "changes"),
    [
        (DISCRETE, {}),
        pytest.param(BOX, {"kfac_length": "factors"}, marks=pytest.mark.slow),
        pytest.param(DISCRETE, {**MOMENTUM, "kfac_length": "factors"}, marks=pytest.mark.slow),
        (BOX, MOMENTUM),
        pytest.param(DISCRETE, {"kl_bound": 1e9, "lr": 0.02}, marks=pytest.mark.slow),
    ],
)
def test_steps_equal_whole_matrices_and_loops_over_rows(spec: EnvSpec, changes: dict[str, Any]) -> None:
    """Three steps, so that averages, inverses and momentum are carried over."""
    config = replace(CONFIG, **changes)
    update = _update(spec, config)
    naive = [Naive(config, update.actor, p) for p in range(P)]
    for iteration in range(3):
        rows, advantages = _rows(spec, iteration)
        info = update.improve(rows, advantages, _generators(iteration))
        for p, random in enumerate(_generators(iteration)):
            eta, expected = naive[p].improve(rows, advantages, random)
            assert float(info["step"][p]) == pytest.approx(eta, rel=1e-8)
            assert float(info["predicted_kl"][p]) == pytest.approx(expected, rel=1e-8)
    for p, one in enumerate(naive):
        for mine, theirs in zip(update.actor.network.weights, one.weights, strict=True):
            torch.testing.assert_close(mine[p], theirs, rtol=1e-8, atol=1e-8)
        for mine, theirs in zip(update.actor.network.biases, one.biases, strict=True):
            torch.testing.assert_close(mine[p, :, 0], theirs, rtol=1e-8, atol=1e-8)
        if one.log_std is not None:
            assert update.actor.log_std is not None
            torch.testing.assert_close(update.actor.log_std[p, :, 0], one.log_std, rtol=1e-8, atol=1e-8)


@every_space
@pytest.mark.parametrize("bound", [pytest.param(1e-6, marks=pytest.mark.slow), 1e-2])
def test_the_kl_divergence_equals_the_prediction_of_the_exact_length(spec: EnvSpec, bound: float) -> None:
    """They agree to second order when damping is left out, and hence more closely with a tighter bound."""
    config = replace(CONFIG, kl_bound=bound, lr=1e9)
    update = _update(spec, config)
    for iteration in range(2):
        rows, advantages = _rows(spec, iteration)
        found = [Alone(update.actor, rows, advantages, p) for p in range(P)]
        moved, info = _moved(update, rows, advantages, _generators(iteration))
        for p, one in enumerate(found):
            expected = 0.5 * moved[p] @ one.fisher() @ moved[p]
            damping = 0.5 * config.kfac_damping * moved[p] @ moved[p]
            assert float(info["predicted_kl"][p]) == pytest.approx(float(expected + damping), rel=1e-8)
            assert float(info["predicted_kl"][p]) == pytest.approx(bound, rel=1e-12)
            assert float(info["kl"][p]) == pytest.approx(float(one.kl(one.start + moved[p])), rel=1e-6)
            assert float(info["kl"][p]) == pytest.approx(float(expected), rel=0.3 if bound > 1e-3 else 5e-3)


def test_annealing_scales_steps_with_either_bound() -> None:
    for config in (replace(CONFIG, lr=1e9), replace(CONFIG, kl_bound=1e9)):
        moves = []
        for share in (1.0, 0.1):
            update = _update(DISCRETE, config)
            update.anneal(share)
            moves.append(_moved(update, *_rows(DISCRETE), _generators(0))[0])
        torch.testing.assert_close(moves[1], 0.1 * moves[0], rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("masked", [False, True])
def test_sampled_scores_of_a_categorical_have_the_fisher_information_as_covariance(masked: bool) -> None:
    """Scores drawn with evenly spaced uniforms have mean 0 and the Fisher information as covariance;
    forbidden actions are never sampled."""
    count = 4000
    random = torch.Generator().manual_seed(0)
    logits = torch.randn(1, A, 1, generator=random, dtype=DOUBLE).expand(-1, -1, count)
    masks = torch.tensor([True, False, True]).expand(1, count, A) if masked else None
    distribution = MaskedCategorical.of_logits(logits, masks)
    score = distribution.drawn_score(((torch.arange(count, dtype=DOUBLE) + 0.5) / count)[None])[0]
    torch.testing.assert_close(score.mean(1), torch.zeros(A, dtype=DOUBLE), rtol=0, atol=1e-3)
    expected = torch.cat(
        [distribution.fisher_of_outputs(e.view(1, A, 1))[0, :, :1] for e in torch.eye(A, dtype=DOUBLE)], 1
    )
    torch.testing.assert_close(score @ score.T / count, expected, rtol=0, atol=1e-3)
    assert not masked or bool((score[1] == 0).all())


def test_sampled_scores_of_a_gaussian_are_gradients_of_its_log_density() -> None:
    random = torch.Generator().manual_seed(0)
    mean, log_std = (torch.randn(1, A, n, generator=random, dtype=DOUBLE) for n in (5, 1))
    noise = torch.randn(1, 5, A, generator=random, dtype=DOUBLE)
    mean.requires_grad_()
    distribution = DiagonalGaussian(mean, log_std)
    drawn = mean.detach() + log_std.exp() * noise.transpose(1, 2)
    (expected,) = torch.autograd.grad(distribution.log_prob(drawn.transpose(1, 2)).sum(), mean)
    torch.testing.assert_close(distribution.drawn_score(noise), expected)


def test_other_networks_are_refused_in_one_line() -> None:
    update = _update(DISCRETE)
    update.actor.network = nn.Linear(2, 2)  # type: ignore[assignment]
    with pytest.raises(HeadwayError, match="K-FAC needs multilayer perceptrons") as caught:
        KFAC(update.actor, CONFIG, Layout(Grouping.of("shared", BOX), P, torch.device("cpu"), DOUBLE))
    assert "\n" not in str(caught.value)
    with pytest.raises(HeadwayError, match="K-FAC needs multilayer perceptrons"):
        KFACRegression(nn.Linear(2, 2), CONFIG, 0.1, 0.1)


def _regression(
    bound: float, hidden: tuple[int, ...] = ()
) -> tuple[KFACRegression, StackedMLP, Tensor, Tensor]:
    """A critic, its inputs (P, B, D) and targets (P, B)."""
    random = torch.Generator().manual_seed(3)
    network = StackedMLP(range(P), 1, "test", (D, hidden, 1), "tanh", 1.0, DOUBLE)
    config = configure("custom", critic_update="kfac", kfac_damping=1e-14)
    rows = torch.randn(P, B, D, generator=random, dtype=DOUBLE)
    targets = torch.randn(P, B, generator=random, dtype=DOUBLE)
    return KFACRegression(network, config, 1.0, bound), network, rows, targets


def _regress(regression: KFACRegression, rows: Tensor, targets: Tensor) -> None:
    regression.begin()
    weight = torch.full((P, B), 1 / B, dtype=DOUBLE)
    regression.include(
        rows, None, weight, lambda outputs: ((outputs[:, 0] - targets).square() * weight).sum(1)
    )
    regression.step(np.ones(P, np.bool_))


def test_a_linear_critic_is_at_the_least_squares_solution_after_one_whole_step() -> None:
    regression, network, rows, targets = _regression(bound=1e9)
    _regress(regression, rows, targets)
    for p in range(P):
        design = np.concatenate([rows[p].numpy(), np.ones((B, 1))], axis=1)
        best = np.linalg.lstsq(design, targets[p].numpy())[0]
        np.testing.assert_allclose(network.weights[0][p, 0].detach().numpy(), best[:-1], rtol=1e-5, atol=1e-6)
        np.testing.assert_allclose(float(network.biases[0][p, 0, 0].detach()), best[-1], rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize(("hidden", "tolerance"), [((), 1e-6), ((6,), 0.05)])
def test_a_critics_values_change_by_its_bound(hidden: tuple[int, ...], tolerance: float) -> None:
    """Half the mean squared change: exactly that where values are linear in the parameters."""
    regression, network, rows, targets = _regression(1e-5, hidden)
    before = network(rows).detach()
    _regress(regression, rows, targets)
    change = 0.5 * ((network(rows).detach() - before) ** 2).mean(dim=(1, 2))
    torch.testing.assert_close(change, torch.full_like(change, 1e-5), rtol=tolerance, atol=0)
