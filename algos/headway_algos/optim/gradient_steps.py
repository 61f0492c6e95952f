"""Steps of an optimiser over minibatches by autograd, for a stack of networks."""

from collections.abc import Callable
from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from headway_algos.batches.minibatches import Piece
from headway_algos.batches.schedule import MinibatchSchedule

Steps = Callable[[MinibatchSchedule], tuple[Tensor, Tensor]]
"""Takes one step per minibatch; returns the I metrics (I, P) and the gradient norm (P,) as means over each
network's steps, NaN for a network that took none."""
AddGradients = Callable[[Piece], Tensor]
"""Adds the gradients of a piece of a minibatch; returns its shares of the I metrics, (I, P)."""


class Optimiser(Protocol):
    """Steps P networks along the gradients of a minibatch."""

    def begin(self) -> None:
        """Clear the gradients of the previous minibatch."""
        ...

    def step(self, active: NDArray[np.bool_]) -> Tensor:
        """Step the networks that are active (P,); return the norms of the gradients (P,)."""
        ...


def autograd_steps(optimiser: Optimiser, add_gradients: AddGradients, num_metrics: int) -> Steps:
    """Return the steps that an optimiser takes along the gradients that `add_gradients` adds."""

    def take_steps(schedule: MinibatchSchedule) -> tuple[Tensor, Tensor]:
        metrics: Tensor | None = None
        norms: Tensor | None = None
        steps: NDArray[np.int64] | None = None
        for pieces, active in schedule.pieces():
            optimiser.begin()
            for piece in pieces:
                shares = add_gradients(piece)
                metrics = shares if metrics is None else metrics + shares
            norm = optimiser.step(active)
            norms = norm if norms is None else norms + norm
            steps = active.astype(np.int64) if steps is None else steps + active
        assert norms is not None
        assert steps is not None
        if metrics is None:  # no network has a row
            metrics = norms.new_zeros(num_metrics, len(norms))
        # 0 / 0, where a network took no step, is NaN.
        count = torch.from_numpy(steps).to(norms)
        return metrics / count, norms / count

    return take_steps
