"""Steps of an optimiser over minibatches, for a stack of networks."""

from collections.abc import Callable, Iterable, Sequence
from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from headway_algos.batches.layout import Piece

Learn = Callable[[Piece], Tensor]
"""Adds the gradients of a piece of a minibatch; returns its shares of the I metrics, (I, P)."""


class Optimiser(Protocol):
    """Steps P networks along the gradients of a minibatch."""

    def begin(self) -> None:
        """Clear the gradients of the previous minibatch."""
        ...

    def step(self, active: NDArray[np.bool_]) -> Tensor:
        """Step the networks that are active (P,); return the norms of the gradients (P,)."""
        ...


def gradient_steps(
    optimiser: Optimiser,
    batches: Iterable[tuple[Sequence[Piece], NDArray[np.bool_]]],
    learn: Learn,
    reports: int,
) -> tuple[Tensor, Tensor]:
    """Take one step per minibatch; return the means over a network's steps of the reported numbers (I, P), of
    which there are `reports`, and of the gradient's norm (P,).

    A minibatch is its pieces, which fit the cache, and which networks have rows in it (P,).
    """
    reported: Tensor | None = None
    norms: Tensor | None = None
    steps: NDArray[np.int64] | None = None
    for pieces, active in batches:
        optimiser.begin()
        for piece in pieces:
            shares = learn(piece)
            reported = shares if reported is None else reported + shares
        norm = optimiser.step(active)
        norms = norm if norms is None else norms + norm
        steps = active.astype(np.int64) if steps is None else steps + active
    assert norms is not None
    assert steps is not None
    count = torch.from_numpy(steps).to(norms).clamp(min=1)
    if reported is None:  # no network has a row
        reported = norms.new_zeros(reports, len(norms))
    return reported / count, norms / count
