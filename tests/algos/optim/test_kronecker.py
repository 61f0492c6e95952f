"""Kronecker factors against loops over rows, and their products against the full matrix."""

import numpy as np
import pytest
import torch
from policy_rows import DOUBLE, damped_kronecker
from torch import Tensor, nn

from headway_algos.networks.linearised import LinearisedMLP
from headway_algos.networks.mlp import StackedMLP
from headway_algos.optim.kronecker import KroneckerFactors, inner, joined

P, B, D, OUTPUTS = 3, 9, 3, 2
DAMPING, DECAY = 0.03, 0.6
every_activation = pytest.mark.parametrize("activation", ["tanh", "relu"])


def _network(activation: str = "tanh", hidden: tuple[int, ...] = (5, 4)) -> StackedMLP:
    """A network with randomised parameters."""
    network = StackedMLP(range(P), 1, "test", (D, hidden, OUTPUTS), activation, 0.9, DOUBLE)
    random = torch.Generator().manual_seed(1)
    with torch.no_grad():
        for parameter in network.parameters():
            parameter += 0.3 * torch.randn(parameter.shape, generator=random, dtype=DOUBLE)
    return network


def _batch(seed: int) -> tuple[Tensor, Tensor, Tensor]:
    """Rows (P, B, D), scores (P, O, B) and weights (P, B); policy 1 has fewer rows."""
    random = torch.Generator().manual_seed(seed)
    weight = torch.full((P, B), 1 / B, dtype=DOUBLE)
    weight[1, :4], weight[1, 4:] = 1 / 4, 0
    rows = torch.randn(P, B, D, generator=random, dtype=DOUBLE)
    return rows, torch.randn(P, OUTPUTS, B, generator=random, dtype=DOUBLE), weight


def _include(factors: KroneckerFactors, network: StackedMLP, seed: int, active: list[bool]) -> None:
    rows, score, weight = _batch(seed)
    factors.begin()
    for part in (slice(0, 5), slice(5, B)):
        linear = LinearisedMLP.of(network, rows[:, part])
        factors.include(linear, score[:, :, part], weight[:, part])
    factors.absorb(np.array(active))


def _naive(network: StackedMLP, seed: int, p: int) -> list[Tensor]:
    """A and G of every layer for one batch, row by row, by automatic differentiation."""
    rows, score, weight = _batch(seed)
    layers = [
        (nn.Parameter(w[p].detach().clone()), nn.Parameter(b[p, :, 0].detach().clone()))
        for w, b in zip(network.weights, network.biases, strict=True)
    ]
    factors = [torch.zeros(n, n, dtype=DOUBLE) for w, _ in layers for n in (w.shape[1] + 1, len(w))]
    for b in range(B):
        x, inputs = rows[p, b], []
        for i, (w, bias) in enumerate(layers):
            inputs.append(torch.cat([x.detach(), torch.ones(1, dtype=DOUBLE)]))
            x = w @ x + bias
            if i < len(layers) - 1:
                x = torch.tanh(x) if network.activation == "tanh" else torch.relu(x)
        signals = torch.autograd.grad((score[p, :, b] * x).sum(), [bias for _, bias in layers])
        for i, (a, g) in enumerate(zip(inputs, signals, strict=True)):
            factors[2 * i] += weight[p, b] * torch.outer(a, a)
            factors[2 * i + 1] += weight[p, b] * torch.outer(g, g)
    return factors


@every_activation
def test_factors_are_running_averages_of_those_of_loops_over_rows(activation: str) -> None:
    """The first batches have equal weights, later ones 1 - decay; inactive networks keep their averages."""
    network = _network(activation)
    factors = KroneckerFactors(network, DAMPING, DECAY, 1)
    turns = [[True] * P, [True, False, True], [True] * P, [True] * P]
    for seed, active in enumerate(turns):
        _include(factors, network, seed, active)
    for p in range(P):
        seen = [_naive(network, seed, p) for seed, active in enumerate(turns) if active[p]]
        expected = [torch.zeros_like(factor) for factor in seen[0]]
        for k, batch in enumerate(seen, start=1):
            kept = min(1 - 1 / k, DECAY)
            expected = [kept * old + (1 - kept) * new for old, new in zip(expected, batch, strict=True)]
        for mine, its in zip(factors.averages, expected, strict=True):
            torch.testing.assert_close(mine[p], its, rtol=1e-12, atol=1e-12)
    assert factors.counts.tolist() == [4, 3, 4]


@every_activation
def test_solve_and_product_equal_the_full_damped_matrix(activation: str) -> None:
    network = _network(activation)
    factors = KroneckerFactors(network, DAMPING, DECAY, 1)
    _include(factors, network, 0, [True] * P)
    _include(factors, network, 1, [True] * P)
    random = torch.Generator().manual_seed(5)
    gradient = [torch.randn(t.shape, generator=random, dtype=DOUBLE) for t in network.parameters()]
    direction = joined(gradient)
    solved, multiplied = factors.solve(direction), factors.product(direction)
    for i, matrix in enumerate(direction):
        for p in range(P):
            whole = damped_kronecker(factors.averages[2 * i][p], factors.averages[2 * i + 1][p], DAMPING)
            stacked = matrix[p].T.reshape(-1)  # column by column: (A x G) vec(M) = vec(G M A)
            expected = torch.linalg.solve(whole, stacked).reshape(matrix[p].T.shape).T
            torch.testing.assert_close(solved[i][p], expected, rtol=1e-9, atol=1e-9)
            torch.testing.assert_close(
                multiplied[i][p], (whole @ stacked).reshape(matrix[p].T.shape).T, rtol=1e-10, atol=1e-10
            )
    squares = torch.stack([(g[1] ** 2).sum() for g in gradient]).sum()
    torch.testing.assert_close(inner(direction, direction)[1], squares)


def test_inverses_are_renewed_at_each_networks_own_batches() -> None:
    """`every` 3: at its first batch and its fourth."""
    network = _network()
    factors = KroneckerFactors(network, DAMPING, DECAY, 3)
    renewed: list[list[bool]] = []
    turns = [[True, True, False], [True, False, True], [True, True, True], [True, True, True], [True] * 3]
    for seed, active in enumerate(turns):
        before = [inverse.clone() for inverse in factors.inverses]
        _include(factors, network, seed, active)
        changes = [(old != new).flatten(1).any(1) for old, new in zip(before, factors.inverses, strict=True)]
        assert all(torch.equal(change, changes[0]) for change in changes)
        renewed.append(changes[0].tolist())
    assert renewed == [
        [True, True, False], [False, False, True], [False, False, False], [True, False, False],
        [False, True, True],
    ]  # fmt: skip


def test_before_its_first_batch_a_network_does_not_move() -> None:
    network = _network()
    factors = KroneckerFactors(network, DAMPING, DECAY, 1)
    _include(factors, network, 0, [True, False, True])
    solved = factors.solve(joined([torch.ones_like(t) for t in network.parameters()]))
    assert [bool((solved[0][p] == 0).all()) for p in range(P)] == [False, True, False]


def test_directions_are_finite_without_signals() -> None:
    """Signals are 0 if a single action is allowed in every row."""
    network = _network()
    factors = KroneckerFactors(network, DAMPING, DECAY, 1)
    rows, score, weight = _batch(0)
    score[0] = 0
    factors.begin()
    factors.include(LinearisedMLP.of(network, rows), score, weight)
    factors.absorb(np.ones(P, np.bool_))
    assert (factors.averages[1][0] == 0).all()
    solved = factors.solve(joined([torch.ones_like(t) for t in network.parameters()]))
    assert all(bool(torch.isfinite(part).all()) for part in solved)
