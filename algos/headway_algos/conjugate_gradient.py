"""Conjugate gradient (Hestenes and Stiefel 1952) for a stack of linear systems, each solved by itself."""

from collections.abc import Callable

import torch
from torch import Tensor

TOLERANCE = 1e-20
"""A system whose squared residual has come down to this share of its squared right-hand side is solved."""


def conjugate_gradient(product: Callable[[Tensor], Tensor], target: Tensor, iterations: int) -> Tensor:
    """x (P, V) with product(x) near target (P, V), after at most so many iterations from 0.

    `product` multiplies each system's vector by its own symmetric, positive definite matrix. A system that is
    solved, or whose target is 0, is left as it is while others go on.
    """
    solution = torch.zeros_like(target)
    residual, direction = target.clone(), target.clone()
    squared = (residual**2).sum(1, keepdim=True)
    enough = TOLERANCE * squared
    for _ in range(iterations):
        unsolved = squared > enough
        if not unsolved.any():
            break
        along = product(direction)
        curvature = (direction * along).sum(1, keepdim=True)
        step = torch.where(unsolved, squared / curvature, 0)
        solution = solution + step * direction
        residual = residual - step * along
        new_squared = (residual**2).sum(1, keepdim=True)
        direction = residual + torch.where(unsolved, new_squared / squared, 0) * direction
        squared = new_squared
    return solution
