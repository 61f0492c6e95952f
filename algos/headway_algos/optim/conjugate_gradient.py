"""Conjugate gradient (Hestenes and Stiefel 1952) for a stack of linear systems, each solved by itself."""

from collections.abc import Callable

import torch
from torch import Tensor

TOLERANCE = 1e-24
"""A system whose squared residual has come down to this share of its squared right-hand side is solved."""


def conjugate_gradient(
    product: Callable[[Tensor], Tensor], target: Tensor, iterations: int
) -> tuple[Tensor, Tensor]:
    """x (P, V) with product(x) near target (P, V), after at most so many iterations from 0; and product(x).

    `product` multiplies each system's vector by its own symmetric, positive definite matrix. A system that is
    solved, or whose target is 0, is left as it is while others go on. Residuals are kept orthogonal to those
    before, which they are but for rounding: where one eigenvalue stands out, rounding was else seen to grow
    ten-millionfold in ten iterations (Golub and Van Loan, "Matrix Computations", on Lanczos' method).
    """
    solution, image = torch.zeros_like(target), torch.zeros_like(target)
    residual, direction = target.clone(), target.clone()
    squared = (residual**2).sum(1, keepdim=True)
    enough = TOLERANCE * squared
    earlier: list[Tensor] = []
    for _ in range(iterations):
        unsolved = squared > enough
        if not unsolved.any():
            break
        earlier.append(torch.where(unsolved, residual / squared.sqrt(), 0))
        along = product(direction)
        curvature = (direction * along).sum(1, keepdim=True)
        step = torch.where(unsolved, squared / curvature, 0)
        solution, image = solution + step * direction, image + step * along
        residual = residual - step * along
        basis = torch.stack(earlier, dim=1)
        residual = residual - (basis.transpose(1, 2) @ (basis @ residual[..., None]))[..., 0]
        new_squared = (residual**2).sum(1, keepdim=True)
        direction = residual + torch.where(unsolved, new_squared / squared, 0) * direction
        squared = new_squared
    return solution, image
