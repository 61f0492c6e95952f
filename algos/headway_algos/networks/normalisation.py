"""Running means and standard deviations, one set per network of a stack."""

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from headway_algos.acting.mlp import OBSERVATION_CLIP

_LOOP_MIN_VALUES = 8192
"""Values per network from which, on a CPU, a loop over networks is faster than masked sums over all rows."""
_ROWS_PER_COPY = 8192
"""Rows gathered at a time before conversion to float64, which bounds temporary memory."""


class RunningStatistics(nn.Module):
    """Mean and variance of all rows included so far, (P, 1, size) each, float64.

    Combined by the parallel formula of Chan, Golub and LeVeque (1979). The mean starts at 0; the variance is
    1 until two rows were included. Stored as buffers, so that checkpoints contain them.
    """

    count: Tensor
    mean: Tensor
    variance: Tensor

    def __init__(self, stack: int, size: int) -> None:
        super().__init__()
        self.register_buffer("count", torch.zeros(stack, 1, 1, dtype=torch.float64))
        self.register_buffer("mean", torch.zeros(stack, 1, size, dtype=torch.float64))
        self.register_buffer("variance", torch.ones(stack, 1, size, dtype=torch.float64))
        self.latest: tuple[Tensor, Tensor, Tensor] | None = None
        """Count (P, 1, 1), mean and sum of squared deviations (P, 1, size) of the last batch included."""

    def include(self, rows: Tensor, selected: NDArray[np.bool_] | None = None) -> None:
        """Include rows (P, B, size) where `selected` (P, B) is true; other rows may hold anything."""
        chosen = np.ones(rows.shape[:2], np.bool_) if selected is None else selected
        count = torch.from_numpy(chosen.sum(axis=1, keepdims=True)[..., None]).to(rows.device).double()
        # Decided by the size per network: the order of summation must not depend on the stack.
        loop = rows.device.type == "cpu" and rows[0].numel() >= _LOOP_MIN_VALUES
        mean, squares = (_deviations_looped if loop else _deviations)(rows, chosen, count.clamp(min=1))
        self.latest = count, mean, squares
        self.add(count, mean, squares)

    def add(self, count: Tensor, mean: Tensor, squares: Tensor) -> None:
        """Include a batch, given its count (P, 1, 1), mean and sum of squared deviations (P, 1, size)."""
        total = self.count + count
        share = count / total.clamp(min=1)
        shift = mean - self.mean
        old_squares = torch.where(self.count > 1, self.variance * self.count, 0)
        new_squares = old_squares + squares + shift**2 * self.count * share
        self.mean += shift * share
        self.variance = torch.where(total > 1, new_squares / total.clamp(min=1), self.variance)
        self.count = total

    def normalised(self, rows: Tensor) -> Tensor:
        """Return rows (P, B, size), standardised and clipped to [-10, 10], in their own dtype."""
        scaled = (rows - self.mean.to(rows.dtype)).mul_(self.scale.to(rows.dtype))
        return scaled.clamp_(-OBSERVATION_CLIP, OBSERVATION_CLIP)

    @property
    def scale(self) -> Tensor:
        """1 / standard deviation, (P, 1, size)."""
        return torch.rsqrt(self.variance + 1e-8)

    @property
    def std(self) -> Tensor:
        """Standard deviation, (P, 1, size)."""
        return torch.sqrt(self.variance + 1e-8)


def _deviations(rows: Tensor, chosen: NDArray[np.bool_], count: Tensor) -> tuple[Tensor, Tensor]:
    """Return means and sums of squared deviations, (P, 1, size) each, of the rows (P, B, size) `chosen`.

    `count` (P, 1, 1) is the number of chosen rows, at least 1; without any, results are 0.
    """
    taken = torch.from_numpy(chosen).to(rows.device)[..., None]
    values = torch.where(taken, rows, 0).double()
    mean = values.sum(1, keepdim=True) / count
    return mean, torch.where(taken, values - mean, 0).square().sum(1, keepdim=True)


def _deviations_looped(rows: Tensor, chosen: NDArray[np.bool_], count: Tensor) -> tuple[Tensor, Tensor]:
    """Return the results of `_deviations` from the chosen rows only, network by network."""
    parts = []
    for of_network, which, number in zip(rows, chosen, count, strict=True):
        row_index = torch.from_numpy(np.flatnonzero(which)).to(rows.device)
        # One float64 copy, changed in place: it takes twice the memory of float32 rows.
        values = torch.empty((len(row_index), rows.shape[2]), dtype=torch.float64, device=rows.device)
        for first in range(0, len(row_index), _ROWS_PER_COPY):
            part = slice(first, first + _ROWS_PER_COPY)
            values[part] = of_network.index_select(0, row_index[part])
        mean = values.sum(0, keepdim=True) / number
        parts.append((mean, values.sub_(mean).square_().sum(0, keepdim=True)))
    means, squares = zip(*parts, strict=True)
    return torch.stack(means), torch.stack(squares)
