"""Conjugate gradient (Hestenes and Stiefel 1952) for a stack of independent linear systems."""

from collections.abc import Callable

import torch
from torch import Tensor

TOLERANCE = 1e-24
"""A system is solved once its squared residual is at most this share of its squared right-hand side."""


def conjugate_gradient(
    product: Callable[[Tensor], Tensor], target: Tensor, iterations: int
) -> tuple[Tensor, Tensor]:
    """Solve product(x) = target (P, V) approximately from x = 0; return x and product(x), (P, V) each.

    `product` multiplies each system's vector by its own symmetric positive definite matrix. Systems that are
    solved, or have target 0, stay unchanged while others continue. Residuals are reorthogonalised against all
    earlier ones: with one dominant eigenvalue, rounding errors otherwise grew ten-millionfold in ten
    iterations (Golub and Van Loan, "Matrix Computations", on the Lanczos method).
    """
    solution, image = torch.zeros_like(target), torch.zeros_like(target)
    residual, direction = target.clone(), target.clone()
    squared = (residual**2).sum(1, keepdim=True)
    tolerance = TOLERANCE * squared
    earlier: list[Tensor] = []
    for _ in range(iterations):
        unsolved = squared > tolerance
        if not unsolved.any():
            break
        earlier.append(torch.where(unsolved, residual / squared.sqrt(), 0))
        along = product(direction)
        curvature = (direction * along).sum(1, keepdim=True)
        step = torch.where(unsolved, squared / curvature, 0)
        solution, image = solution + step * direction, image + step * along
        residual = residual - step * along
        # In exact arithmetic the residual would already be orthogonal to all earlier ones.
        basis = torch.stack(earlier, dim=1)
        residual = residual - (basis.transpose(1, 2) @ (basis @ residual[..., None]))[..., 0]
        new_squared = (residual**2).sum(1, keepdim=True)
        direction = residual + torch.where(unsolved, new_squared / squared, 0) * direction
        squared = new_squared
    return solution, image
