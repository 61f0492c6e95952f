"""Conjugate gradient against direct solutions."""

import torch
from torch import Tensor

from headway_algos.optim.conjugate_gradient import conjugate_gradient

DOUBLE = torch.float64


def _systems(stack: int, size: int, seed: int = 0) -> tuple[Tensor, Tensor]:
    """Positive definite matrices (P, V, V) with one eigenvalue far above the others, and targets (P, V)."""
    random = torch.Generator().manual_seed(seed)
    factors = torch.randn(stack, size, size, generator=random, dtype=DOUBLE)
    factors[:, :, 0] *= 100
    matrices = factors @ factors.transpose(1, 2) / size + 0.1 * torch.eye(size, dtype=DOUBLE)
    return matrices, torch.randn(stack, size, generator=random, dtype=DOUBLE)


def _times(matrices: Tensor, vectors: Tensor) -> Tensor:
    return (matrices @ vectors[..., None])[..., 0]


def test_with_one_iteration_per_dimension_the_solution_is_exact() -> None:
    """Further iterations do not change the solution."""
    matrices, targets = _systems(4, 6)
    exact = torch.linalg.solve(matrices, targets)
    for iterations in (6, 50):
        solution, image = conjugate_gradient(lambda v: _times(matrices, v), targets, iterations)
        torch.testing.assert_close(solution, exact, rtol=1e-9, atol=1e-9)
        torch.testing.assert_close(image, targets, rtol=1e-9, atol=1e-9)


def test_after_few_iterations_it_is_the_best_of_the_krylov_space() -> None:
    """x in span(b, A b, A^2 b) with the least x^T A x / 2 - b^T x, which defines the method."""
    matrices, targets = _systems(3, 9)
    solution, image = conjugate_gradient(lambda v: _times(matrices, v), targets, 3)
    torch.testing.assert_close(image, _times(matrices, solution), rtol=1e-10, atol=1e-10)
    for matrix, target, found in zip(matrices, targets, solution, strict=True):
        basis, _ = torch.linalg.qr(torch.stack([target, matrix @ target, matrix @ (matrix @ target)], 1))
        best = basis @ torch.linalg.solve(basis.T @ matrix @ basis, basis.T @ target)
        torch.testing.assert_close(found, best, rtol=1e-8, atol=1e-8)


def test_a_solved_system_stays_unchanged() -> None:
    """One needs a single iteration, one none; neither affects the others."""
    matrices, targets = _systems(4, 8)
    matrices[1], targets[2] = 3 * torch.eye(8, dtype=DOUBLE), 0
    solution, _ = conjugate_gradient(lambda v: _times(matrices, v), targets, 8)
    torch.testing.assert_close(solution, torch.linalg.solve(matrices, targets), rtol=1e-9, atol=1e-9)
    assert torch.equal(solution[2], torch.zeros(8, dtype=DOUBLE))


def test_rounding_in_the_products_does_not_grow() -> None:
    """Ten iterations of sixty: without orthogonal residuals a change of 1e-14 was seen to become 0.7."""
    matrices, targets = _systems(5, 60)
    noise = 1 + 1e-14 * torch.randn(5, 60, generator=torch.Generator().manual_seed(1), dtype=DOUBLE)
    clean, _ = conjugate_gradient(lambda v: _times(matrices, v), targets, 10)
    rough, _ = conjugate_gradient(lambda v: _times(matrices, v) * noise, targets, 10)
    torch.testing.assert_close(clean, rough, rtol=1e-9, atol=1e-9)
