"""The stacked Adam: each network's moments and step count are its own."""

import numpy as np
import pytest
import torch

from headway_algos.optim.adam import StackedAdam

DOUBLE = torch.float64
SHAPES = ((3, 4), (3, 1))


def _parameters(stack: int, seed: int = 0) -> list[torch.nn.Parameter]:
    random = torch.Generator().manual_seed(seed)
    return [torch.nn.Parameter(torch.randn(stack, *s, generator=random, dtype=DOUBLE)) for s in SHAPES]


@pytest.fixture
def by_torch(monkeypatch: pytest.MonkeyPatch) -> None:
    """Use the code path of a GPU."""
    monkeypatch.setattr(StackedAdam, "_step_compiled", StackedAdam._step_by_torch)


@pytest.fixture(params=["compiled", "by torch"])
def either(request: pytest.FixtureRequest) -> None:
    """Run with each code path."""
    if request.param == "by torch":
        request.getfixturevalue("by_torch")


@pytest.mark.usefixtures("either")
@pytest.mark.parametrize("grad_clip", [None, 0.5])
def test_networks_that_step_at_different_times_equal_torchs_adam_alone(grad_clip: float | None) -> None:
    """One starts late: its bias correction is then that of a new optimiser."""
    stack, signals = 3, [_parameters(3, 10 + step) for step in range(7)]
    together = _parameters(stack)
    alone = [[torch.nn.Parameter(t[p].detach().clone()) for t in together] for p in range(stack)]
    ours = StackedAdam(together, 0.05, grad_clip)
    theirs = [torch.optim.Adam(tensors, lr=0.05, eps=1e-5) for tensors in alone]
    for step, active in enumerate(
        [[1, 0, 1], [1, 0, 0], [1, 1, 1], [0, 0, 0], [0, 1, 1], [1, 1, 1], [1, 1, 1]]
    ):
        ours.begin()
        for tensor, signal in zip(together, signals[step], strict=True):
            tensor.grad = signal.detach().clone()
        norms = ours.step(np.array(active, np.bool_))
        for p in np.flatnonzero(active):
            for tensor, signal in zip(alone[p], signals[step], strict=True):
                tensor.grad = signal.detach()[p].clone()
            norm = torch.nn.utils.clip_grad_norm_(alone[p], grad_clip or float("inf"))
            theirs[p].step()
            assert float(norms[p]) == pytest.approx(float(norm), rel=1e-12)
        assert (norms[~torch.tensor(active, dtype=torch.bool)] == 0).all()
    assert ours.counts.tolist() == [5, 4, 5]
    for p in range(stack):
        for tensor, single in zip(together, alone[p], strict=True):
            torch.testing.assert_close(tensor[p], single, rtol=1e-12, atol=1e-12)


@pytest.mark.usefixtures("by_torch")
def test_a_stack_steps_by_torch_bit_for_bit_as_torchs_fused_adam() -> None:
    mine, its = _parameters(3), _parameters(3)
    ours, theirs = StackedAdam(mine, 0.05, None), torch.optim.Adam(its, lr=0.05, eps=1e-5, fused=True)
    for step in range(4):
        ours.begin()
        for tensors in (mine, its):
            for tensor, signal in zip(tensors, _parameters(3, 20 + step), strict=True):
                tensor.grad = signal.detach().clone()
        ours.step(np.ones(3, np.bool_))
        theirs.step()
    assert all(torch.equal(a, b) for a, b in zip(mine, its, strict=True))


def test_a_restored_optimiser_continues_like_the_stored_one_without_sharing_tensors() -> None:
    first = _parameters(2)
    stored = StackedAdam(first, 0.05, None)

    def step(optimiser: StackedAdam, seed: int, active: list[bool]) -> None:
        for tensor, signal in zip(optimiser.parameters, _parameters(2, seed), strict=True):
            tensor.grad = signal.detach().clone()
        optimiser.step(np.array(active))

    step(stored, 1, [True, False])
    second = [torch.nn.Parameter(tensor.detach().clone()) for tensor in first]
    restored = StackedAdam(second, 0.05, None)
    restored.load_state_dict(stored.state_dict())
    for optimiser in (stored, restored):
        step(optimiser, 2, [True, True])
    assert stored.counts.tolist() == restored.counts.tolist() == [2, 1]
    assert all(torch.equal(a, b) for a, b in zip(first, second, strict=True))


def test_the_memory_layout_of_a_gradient_does_not_matter() -> None:
    mine, its = _parameters(3), _parameters(3)
    ours, theirs = StackedAdam(mine, 0.05, None), StackedAdam(its, 0.05, None)
    for tensor, other, signal in zip(mine, its, _parameters(3, 20), strict=True):
        tensor.grad = signal.detach().transpose(0, 1).contiguous().transpose(0, 1)
        other.grad = signal.detach().clone()
    for optimiser in (ours, theirs):
        optimiser.step(np.ones(3, np.bool_))
    assert all(torch.equal(a, b) for a, b in zip(mine, its, strict=True))


def test_parameters_given_to_another_optimiser_are_not_stepped_by_the_first() -> None:
    parameters = _parameters(2)
    first = StackedAdam(parameters, 0.05, None)
    StackedAdam(parameters, 0.05, None)
    with pytest.raises(RuntimeError, match="given to another optimiser"):
        first.step(np.ones(2, np.bool_))


def test_a_moved_parameter_is_detected() -> None:
    parameters = _parameters(2)
    optimiser = StackedAdam(parameters, 0.05, None)
    parameters[1].data = parameters[1].detach().clone()
    with pytest.raises(RuntimeError, match="was moved"):
        optimiser.step(np.ones(2, np.bool_))


def test_parameters_that_become_views_keep_their_values_and_stay_apart() -> None:
    parameters, as_they_were = _parameters(3), _parameters(3)
    optimiser = StackedAdam(parameters, 0.05, None)
    assert all(torch.equal(a, b) for a, b in zip(parameters, as_they_were, strict=True))
    with torch.no_grad():
        parameters[1].zero_()
    assert torch.equal(parameters[0], as_they_were[0])
    assert optimiser.values.whole.count_nonzero() == parameters[0].numel()


@pytest.mark.parametrize("dtype", [torch.float32, DOUBLE])
@pytest.mark.parametrize("size", [1, 15, 33, 100, 2401])
def test_a_network_steps_bit_for_bit_the_same_in_any_stack(size: int, dtype: torch.dtype) -> None:
    random = torch.Generator().manual_seed(size)
    start, *signals = (torch.randn(5, size, generator=random, dtype=dtype) for _ in range(5))
    together = torch.nn.Parameter(start.clone())
    alone = [torch.nn.Parameter(row[None].clone()) for row in start]
    optimisers = [StackedAdam([tensor], 1e-3, 0.5) for tensor in (together, *alone)]
    for signal in signals:
        for tensor, gradient in zip((together, *alone), (signal, *signal[:, None]), strict=True):
            tensor.grad = gradient.clone()
        for optimiser in optimisers:
            optimiser.step(np.ones(len(optimiser.counts), np.bool_))
    whole, *parts = optimisers
    for kind in ("values", "means", "squares"):
        alike = torch.cat([getattr(part, kind).whole for part in parts])
        assert torch.equal(getattr(whole, kind).whole, alike), kind


@pytest.mark.usefixtures("either")
def test_a_parameter_without_a_new_gradient_gets_zero() -> None:
    parameters, alone = _parameters(2), _parameters(2)
    ours, theirs = StackedAdam(parameters, 0.05, None), torch.optim.Adam(alone, lr=0.05, eps=1e-5)
    for step, given in enumerate(((0, 1), (1,))):
        ours.begin()
        for place, signal in enumerate(_parameters(2, 30 + step)):
            alone[place].grad = signal.detach() * (place in given)
            if place in given:
                parameters[place].grad = signal.detach().clone()
        ours.step(np.ones(2, np.bool_))
        theirs.step()
    for mine, its in zip(parameters, alone, strict=True):
        torch.testing.assert_close(mine, its, rtol=1e-12, atol=1e-12)


@pytest.mark.usefixtures("either")
def test_a_nan_gradient_makes_the_whole_network_nan() -> None:
    parameters = _parameters(2)
    optimiser = StackedAdam(parameters, 0.05, 0.5)
    for parameter, signal in zip(parameters, _parameters(2, 1), strict=True):
        parameter.grad = signal.detach().clone()
    assert parameters[0].grad is not None
    parameters[0].grad[1, 0, 0] = torch.nan
    norms = optimiser.step(np.ones(2, np.bool_))
    assert torch.isnan(norms).tolist() == [False, True]
    for parameter in parameters:
        assert torch.isnan(parameter[1]).all()
        assert torch.isfinite(parameter[0]).all()
