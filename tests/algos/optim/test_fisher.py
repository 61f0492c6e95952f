"""Fisher products against the explicit matrix and automatic differentiation, and products with J."""

from copy import deepcopy
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.func import functional_call

from headway.contracts import ActionSpace, Box, Discrete, EnvSpec, MultiDiscrete
from headway_algos.batches.policy_batch import PolicyBatch
from headway_algos.batches.whole_batch import WholeBatch
from headway_algos.config import ModelConfig
from headway_algos.kernels.perceptron import ROWS
from headway_algos.networks.actor import Actor
from headway_algos.networks.linearised import LinearisedMLP
from headway_algos.optim.fisher import (
    compiled_gauss_newton,
    double_backward,
    fisher_product,
    gauss_newton,
    to_vector,
)

P, B, D, A = 3, 14, 3, 4
DOUBLE = torch.float64
SPACES: dict[str, ActionSpace] = {
    "discrete": Discrete(A),
    "box": Box((-1.0,) * A, (1.0,) * A),
    "multi": MultiDiscrete((2, A - 2)),
}
NETWORKS: list[tuple[tuple[int, ...], str]] = [
    ((6, 5), "tanh"), ((6, 5), "relu"), ((7,), "tanh"), ((), "tanh"),
]  # fmt: skip
every_network = pytest.mark.parametrize(("hidden", "activation"), NETWORKS)


def _actor(space: str, hidden: tuple[int, ...] = (6, 5), activation: str = "tanh") -> Actor:
    """Policies with randomised parameters."""
    model = ModelConfig(hidden, "tanh" if activation == "tanh" else "relu", actor_gain=0.8)
    actor = Actor(model, EnvSpec("made", ("only",), D, SPACES[space]), range(P), 1, DOUBLE)
    random = torch.Generator().manual_seed(1)
    with torch.no_grad():
        for parameter in actor.parameters():
            parameter += 0.3 * torch.randn(parameter.shape, generator=random, dtype=DOUBLE)
    return actor


def _batch(space: str, masked: bool = False, rows_each: int = B) -> WholeBatch:
    """Policy 1 has fewer rows than the others."""
    random = torch.Generator().manual_seed(2)
    selected = np.ones((P, rows_each), np.bool_)
    selected[1, ::3] = False
    masks = torch.rand(P, rows_each, A, generator=random) < 0.6
    masks[..., 1] |= ~masks.any(-1)
    actions = torch.zeros((P, rows_each) if space == "discrete" else (P, rows_each, A), dtype=torch.int64)
    zeros = torch.zeros(P, rows_each, dtype=DOUBLE)
    rows = PolicyBatch(
        torch.randn(P, rows_each, D, generator=random, dtype=DOUBLE),
        masks if masked else None,
        actions,
        zeros,
        selected,
    )
    return WholeBatch.of(rows, zeros)


def _explicit(actor: Actor, batch: WholeBatch, p: int) -> Tensor:
    """Mean over rows of J^T M J, (V, V), with J by autograd row by row and M as the covariance of the
    score."""
    alone = actor.narrow(torch.tensor([p]))
    total = torch.zeros(())
    for b in range(batch.weight.shape[1]):
        outputs = alone.network(batch.observations[p : p + 1, b : b + 1])[0, :, 0]
        jacobian = torch.stack(
            [
                to_vector(torch.autograd.grad(o, list(alone.network.parameters()), retain_graph=True))[0]
                for o in outputs
            ]
        )
        if alone.log_std is None:
            logits = outputs.detach()
            if batch.masks is not None:
                logits = logits.masked_fill(~batch.masks[p, b], -1000.0)
            chances = torch.softmax(logits, 0)
            scores = torch.eye(A, dtype=DOUBLE) - chances
            fisher = jacobian.T @ (scores.T * chances @ scores) @ jacobian
        else:
            of_mean = jacobian.T @ torch.diag(torch.exp(-2 * alone.log_std.detach()[0, :, 0])) @ jacobian
            fisher = torch.block_diag(2 * torch.eye(A, dtype=DOUBLE), of_mean)
        total = total + batch.weight[p, b] * fisher
    return total


@pytest.mark.parametrize(("space", "masked"), [("discrete", False), ("discrete", True), ("box", False)])
def test_products_equal_the_explicit_matrix(space: str, masked: bool) -> None:
    actor, batch = _actor(space), _batch(space, masked)
    vector = torch.randn(
        to_vector(actor.learnable).shape, generator=torch.Generator().manual_seed(3), dtype=DOUBLE
    )
    expected = torch.stack([_explicit(actor, batch, p) @ vector[p] for p in range(P)])
    for product in (gauss_newton(actor, batch, 10), double_backward(actor, batch, 10)):
        torch.testing.assert_close(product(vector), expected, rtol=1e-10, atol=1e-10)


@every_network
@pytest.mark.parametrize(("space", "masked"), [("discrete", False), ("discrete", True), ("box", False)])
def test_both_forms_are_equal(space: str, masked: bool, hidden: tuple[int, ...], activation: str) -> None:
    actor, batch = _actor(space, hidden, activation), _batch(space, masked)
    random = torch.Generator().manual_seed(4)
    for _ in range(3):
        vector = torch.randn(to_vector(actor.learnable).shape, generator=random, dtype=DOUBLE)
        one = gauss_newton(actor, batch, 10)(vector)
        torch.testing.assert_close(one, double_backward(actor, batch, 50)(vector), rtol=1e-10, atol=1e-10)
        assert torch.equal(one, fisher_product(actor, batch, 10)(vector))


@every_network
@pytest.mark.parametrize(
    ("space", "masked"), [("discrete", False), ("discrete", True), ("box", False), ("multi", True)]
)
def test_compiled_products_equal_those_of_torch_in_float64(
    space: str, masked: bool, hidden: tuple[int, ...], activation: str
) -> None:
    """Rows are in several blocks; a policy's product has the same bits without the other policies."""
    precise, batch = _actor(space, hidden, activation), _batch(space, masked, 2 * ROWS + 37)
    actor = deepcopy(precise).float()
    single = replace(batch, observations=batch.observations.float(), weight=batch.weight.float())
    product = compiled_gauss_newton(actor, single)
    assert product is not None
    assert compiled_gauss_newton(precise, batch) is None
    random = torch.Generator().manual_seed(5)
    for _ in range(2):
        vector = torch.randn(to_vector(actor.learnable).shape, generator=random)
        expected = gauss_newton(precise, batch, 10_000)(vector.double())
        torch.testing.assert_close(product(vector).double(), expected, rtol=1e-4, atol=1e-5)
    alone = single.narrow(torch.tensor([1]))
    own = slice(int((alone.weight > 0).sum()))
    alone = replace(
        alone,
        observations=alone.observations[:, own],
        masks=None if alone.masks is None else alone.masks[:, own],
        weight=alone.weight[:, own],
    )
    narrowed = compiled_gauss_newton(actor.narrow(torch.tensor([1])), alone)
    assert narrowed is not None
    assert torch.equal(narrowed(vector[1:2]), product(vector)[1:2])


def test_a_policy_without_rows_has_no_fisher_information() -> None:
    """The log standard deviation of such a policy has none either."""
    actor, batch = _actor("box"), _batch("box")
    weight = batch.weight.clone()
    weight[1] = 0
    batch = replace(batch, weight=weight)
    vector = torch.ones_like(to_vector(actor.learnable))
    single = replace(batch, observations=batch.observations.float(), weight=batch.weight.float())
    compiled = compiled_gauss_newton(deepcopy(actor).float(), single)
    assert compiled is not None
    assert (compiled(vector.float())[1] == 0).all()
    none = replace(single, observations=single.observations[:, :0], weight=single.weight[:, :0])
    without = compiled_gauss_newton(deepcopy(actor).float(), none)
    assert without is not None
    assert (without(vector.float()) == 0).all()
    for product in (gauss_newton(actor, batch, 10), double_backward(actor, batch, 10)):
        assert (product(vector)[1] == 0).all()
        assert (product(vector)[0] != 0).any()


@every_network
def test_jvp_and_vjp_equal_the_jacobian(hidden: tuple[int, ...], activation: str) -> None:
    network = _actor("discrete", hidden, activation).network
    rows = torch.randn(P, B, D, generator=torch.Generator().manual_seed(5), dtype=DOUBLE)
    linear = LinearisedMLP.of(network, rows)
    named = {name: value.detach() for name, value in network.named_parameters()}
    random = torch.Generator().manual_seed(6)
    change = [torch.randn(t.shape, generator=random, dtype=DOUBLE) for t in named.values()]

    def outputs(along: Tensor) -> Tensor:
        moved = {n: t + along * c for (n, t), c in zip(named.items(), change, strict=True)}
        result: Tensor = functional_call(network, moved, (rows,))
        return result

    step = torch.tensor(1e-6, dtype=DOUBLE)
    slope = (outputs(step) - outputs(-step)) / (2 * step)
    torch.testing.assert_close(linear.jvp(change), slope, rtol=1e-7, atol=1e-7)
    signal = torch.randn(linear.outputs.shape, generator=random, dtype=DOUBLE)
    expected = torch.autograd.grad(network(rows), list(network.parameters()), signal)
    for mine, theirs in zip(linear.vjp(signal), expected, strict=True):
        torch.testing.assert_close(mine, theirs, rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(linear.outputs, network(rows).detach(), rtol=0, atol=0)
