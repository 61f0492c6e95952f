"""In what order a team's policies are improved."""

from collections.abc import Callable

from torch import Tensor

Improve = Callable[[Tensor], dict[str, Tensor]]
"""Advantages (P, B) -> info, each (P,); changes the policies."""


def simultaneous(improve: Improve, advantages: Tensor) -> dict[str, Tensor]:
    """All policies at once, each against the others as they were."""
    return improve(advantages)
