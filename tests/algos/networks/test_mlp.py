"""Stacked networks: the tanh layer, initialisation, and the running moments before them."""

import numpy as np
import pytest
import torch
from learned import alone

from headway.contracts import generator
from headway_algos.networks.mlp import StackedMLP, orthogonal, tanh_layer
from headway_algos.networks.normalisation import RunningStatistics

DOUBLE = torch.float64


def test_tanh_layer_by_finite_differences() -> None:
    random = torch.Generator().manual_seed(0)
    shapes = [(2, 3, 4), (2, 5, 3), (2, 5, 1)]
    x, weight, bias = (torch.randn(s, generator=random, dtype=DOUBLE, requires_grad=True) for s in shapes)
    assert torch.autograd.gradcheck(tanh_layer, (x, weight, bias))
    assert torch.autograd.gradgradcheck(tanh_layer, (x, weight, bias))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_tanh_layer_equals_torchs_tanh(dtype: torch.dtype) -> None:
    random = torch.Generator().manual_seed(1)
    shapes = [(3, 4, 100), (3, 6, 4), (3, 6, 1)]
    tensors = [torch.randn(s, generator=random, dtype=dtype, requires_grad=True) for s in shapes]
    x, weight, bias = tensors
    ours, theirs = tanh_layer(x, weight, bias), torch.tanh(torch.bmm(weight, x) + bias)
    tolerance = 1e-5 if dtype == torch.float32 else 1e-12
    torch.testing.assert_close(ours, theirs, rtol=tolerance, atol=tolerance)
    signal = torch.randn(ours.shape, generator=random, dtype=dtype)
    for mine, torchs in zip(
        torch.autograd.grad(ours, tensors, signal), torch.autograd.grad(theirs, tensors, signal), strict=True
    ):
        torch.testing.assert_close(mine, torchs, rtol=10 * tolerance, atol=10 * tolerance)


def test_tanh_layer_leaves_its_inputs_alone() -> None:
    x = torch.randn(1, 2, 3, dtype=DOUBLE).transpose(1, 2).requires_grad_()
    weight, bias = torch.randn(1, 4, 3, dtype=DOUBLE), torch.randn(1, 4, 1, dtype=DOUBLE)
    before = [t.detach().clone() for t in (x, weight, bias)]
    tanh_layer(x, weight, bias)
    for tensor, copy in zip((x, weight, bias), before, strict=True):
        assert torch.equal(tensor, copy)


@pytest.mark.parametrize(("rows", "columns"), [(8, 8), (8, 3), (3, 8), (1, 5)])
def test_orthogonal_initialisation(rows: int, columns: int) -> None:
    matrix = orthogonal(generator(0, "test"), rows, columns, gain=0.5)
    assert matrix.shape == (rows, columns)
    product = matrix @ matrix.T if rows <= columns else matrix.T @ matrix
    np.testing.assert_allclose(product, 0.25 * np.eye(min(rows, columns)), rtol=0, atol=1e-12)


def test_orthogonal_matrices_have_no_preferred_sign() -> None:
    """Haar measure: every entry's mean is 0, which a plain QR decomposition does not give."""
    entries = [orthogonal(generator(i, "test"), 3, 3, 1.0) for i in range(2000)]
    assert np.abs(np.mean(entries, axis=0)).max() < 5 / np.sqrt(3 * 2000)


@pytest.mark.parametrize("activation", ["tanh", "relu"])
def test_stacked_networks_equal_each_alone_in_torch(activation: str) -> None:
    stacked = StackedMLP((4, 9), 3, "actor", (5, (7, 6), 2), activation, 0.01, DOUBLE)
    with torch.no_grad():
        for bias in stacked.biases:
            bias.normal_(generator=torch.Generator().manual_seed(2))
    rows = torch.randn(6, 11, 5, dtype=DOUBLE, generator=torch.Generator().manual_seed(3))
    got = stacked(rows)
    for p in range(6):
        torch.testing.assert_close(got[p].T, alone(stacked, p)(rows[p]), rtol=1e-12, atol=1e-12)


def test_a_policys_first_weights_depend_on_its_seed_and_place_alone() -> None:
    both = StackedMLP((4, 9), 2, "actor", (5, (7,), 2), "tanh", 0.01, DOUBLE)
    alone = StackedMLP((9,), 2, "actor", (5, (7,), 2), "tanh", 0.01, DOUBLE)
    other = StackedMLP((9,), 2, "critic", (5, (7,), 2), "tanh", 0.01, DOUBLE)
    for in_both, by_itself, of_other in zip(both.weights, alone.weights, other.weights, strict=True):
        assert torch.equal(in_both[2:], by_itself)
        assert not torch.equal(in_both[0], in_both[1])
        assert not torch.equal(of_other, by_itself)


@pytest.mark.parametrize("size", [4, 500], ids=["few values", "many values"])
def test_running_moments_equal_numpys_on_all_data_at_once(size: int) -> None:
    draw = np.random.default_rng(0)
    moments = RunningStatistics(3, size)
    seen: list[list[np.ndarray[tuple[int, ...], np.dtype[np.float64]]]] = [[], [], []]
    for batch in range(6):
        rows = 1e4 + draw.normal(size=(3, 20 + batch, size)) * np.geomspace(0.1, 100, size)
        selected = draw.random(rows.shape[:2]) < [[0.0 if batch < 3 else 0.5], [0.5], [1.0]]
        rows[~selected] = np.nan
        moments.include(torch.from_numpy(rows), selected)
        for p in range(3):
            seen[p].append(rows[p, selected[p]])
        if batch == 2:
            assert torch.equal(moments.mean[0], torch.zeros(1, size, dtype=DOUBLE))
            assert torch.equal(moments.variance[0], torch.ones(1, size, dtype=DOUBLE))
    for p in range(3):
        every = np.concatenate(seen[p])
        assert float(moments.count[p]) == len(every)
        np.testing.assert_allclose(moments.mean[p, 0], every.mean(axis=0), rtol=1e-12)
        np.testing.assert_allclose(moments.variance[p, 0], every.var(axis=0), rtol=1e-6)
        np.testing.assert_allclose(moments.std[p, 0] * moments.scale[p, 0], 1, rtol=1e-12)


def test_running_moments_take_rows_that_are_gathered_slice_by_slice() -> None:
    draw = np.random.default_rng(3)
    rows, selected = draw.normal(size=(1, 30_000, 2)) * [1.0, 50.0], draw.random((1, 30_000)) < 0.8
    moments = RunningStatistics(1, 2)
    moments.include(torch.from_numpy(rows), selected)
    np.testing.assert_allclose(moments.mean[0, 0], rows[selected].mean(axis=0), rtol=1e-12, atol=1e-14)
    np.testing.assert_allclose(moments.variance[0, 0], rows[selected].var(axis=0), rtol=1e-12)


@pytest.mark.parametrize("batch", [50, 1000, 3000], ids=["few values", "many in the stack", "many in each"])
@pytest.mark.parametrize("others", [0.5, 1.0], ids=["some of the others", "all of the others"])
def test_running_moments_of_a_network_are_bit_for_bit_those_it_has_alone(batch: int, others: float) -> None:
    """Whatever rows the others of its stack have."""
    draw = np.random.default_rng(2)
    rows = torch.from_numpy(draw.normal(size=(3, batch, 3)).astype(np.float32))
    selected = draw.random((3, batch)) < [[others], [0.7], [others]]
    stacked, alone = RunningStatistics(3, 3), RunningStatistics(1, 3)
    stacked.include(rows, selected)
    alone.include(rows[1:2], selected[1:2])
    assert torch.equal(stacked.mean[1], alone.mean[0])
    assert torch.equal(stacked.variance[1], alone.variance[0])


def test_a_single_row_leaves_no_trace_of_the_variance_assumed_before() -> None:
    rows = torch.tensor([[[3.0], [5.0], [10.0]]], dtype=torch.float64)
    moments = RunningStatistics(1, 1)
    moments.include(rows[:, :1])
    assert float(moments.mean) == 3
    assert float(moments.variance) == 1
    for count in (2, 3):
        moments.include(rows[:, count - 1 : count])
        seen = rows[0, :count, 0].numpy()
        assert float(moments.mean) == pytest.approx(seen.mean(), rel=1e-12)
        assert float(moments.variance) == pytest.approx(seen.var(), rel=1e-12)
