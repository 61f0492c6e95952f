"""Steps of an optimiser over minibatches, for a stack of networks."""

from collections.abc import Callable
from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from headway_algos.batches.epochs import Epochs
from headway_algos.batches.minibatches import Piece
from headway_algos.optim.fast_path import Descent

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
    optimiser: Optimiser, epochs: Epochs, learn: Learn, reports: int, compiled: Descent | None = None
) -> tuple[Tensor, Tensor]:
    """Take one step per minibatch; return means over each network's steps, NaN for a network that took none.

    They are the means of the I = `reports` metrics, (I, P), and of the gradient norm, (P,). `compiled` takes
    the steps in place of `learn` and `optimiser`, whose parameters and state it shares.
    """
    if compiled is not None:
        return compiled(epochs.row_indices())
    reported: Tensor | None = None
    norms: Tensor | None = None
    steps: NDArray[np.int64] | None = None
    for pieces, active in epochs.pieces():
        optimiser.begin()
        for piece in pieces:
            shares = learn(piece)
            reported = shares if reported is None else reported + shares
        norm = optimiser.step(active)
        norms = norm if norms is None else norms + norm
        steps = active.astype(np.int64) if steps is None else steps + active
    assert norms is not None
    assert steps is not None
    if reported is None:  # no network has a row
        reported = norms.new_zeros(reports, len(norms))
    # 0 / 0, where a network took no step, is NaN.
    count = torch.from_numpy(steps).to(norms)
    return reported / count, norms / count
