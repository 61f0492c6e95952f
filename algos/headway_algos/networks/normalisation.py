"""Running means and standard deviations, one for each of a stack of networks."""

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from headway_algos.acting.mlp import OBSERVATION_CLIP

_MANY_VALUES = 8192
"""Of one network, on a CPU: from so many on, summing what is not selected costs more than a loop."""
_ROWS_AT_ONCE = 8192
"""Of one network: so many are gathered before they are copied to float64, so that few lie there twice."""


class RunningStatistics(nn.Module):
    """Mean and variance of all rows seen, by Chan's parallel formula, in float64; (P, 1, size) each.

    Until something was seen the mean is 0, and until two rows were the variance is 1, of which nothing
    remains afterwards. Buffers, so checkpoints hold them.
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
        """Count (P, 1, 1), mean and summed squared deviations (P, 1, size) of the rows included last."""

    def include(self, rows: Tensor, selected: NDArray[np.bool_] | None = None) -> None:
        """Add rows (P, B, size) where `selected` (P, B) holds; the others may hold anything."""
        chosen = np.ones(rows.shape[:2], np.bool_) if selected is None else selected
        count = torch.from_numpy(chosen.sum(axis=1, keepdims=True)[..., None]).to(rows.device).double()
        # By what each network has alone: how it is summed must not depend on those it is stacked with.
        many = rows.device.type == "cpu" and rows[0].numel() >= _MANY_VALUES
        mean, squares = (_one_by_one if many else _at_once)(rows, chosen, count.clamp(min=1))
        self.latest = count, mean, squares
        self.add(count, mean, squares)

    def add(self, count: Tensor, mean: Tensor, squares: Tensor) -> None:
        """Include rows of which that is known: their number (P, 1, 1), mean and summed squared deviations
        from it (P, 1, size)."""
        total = self.count + count
        share = count / total.clamp(min=1)
        shift = mean - self.mean
        old_squares = torch.where(self.count > 1, self.variance * self.count, 0)
        new_squares = old_squares + squares + shift**2 * self.count * share
        self.mean += shift * share
        self.variance = torch.where(total > 1, new_squares / total.clamp(min=1), self.variance)
        self.count = total

    def normalised(self, rows: Tensor) -> Tensor:
        """Rows (P, B, size) in units of the mean and standard deviation, cut at 10; in their precision."""
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


def _at_once(rows: Tensor, chosen: NDArray[np.bool_], count: Tensor) -> tuple[Tensor, Tensor]:
    """Means and summed squared deviations from them, (P, 1, size) each, 0 of none, of the rows (P, B, size)
    chosen, of which each network has `count` (P, 1, 1), or 1 for none."""
    taken = torch.from_numpy(chosen).to(rows.device)[..., None]
    values = torch.where(taken, rows, 0).double()
    mean = values.sum(1, keepdim=True) / count
    return mean, torch.where(taken, values - mean, 0).square().sum(1, keepdim=True)


def _one_by_one(rows: Tensor, chosen: NDArray[np.bool_], count: Tensor) -> tuple[Tensor, Tensor]:
    """The same, of the rows chosen alone."""
    parts = []
    for of_network, which, number in zip(rows, chosen, count, strict=True):
        row_index = torch.from_numpy(np.flatnonzero(which)).to(rows.device)
        # In float64 they take twice the memory that the rows do: there is one such copy, changed in place.
        values = torch.empty((len(row_index), rows.shape[2]), dtype=torch.float64, device=rows.device)
        for first in range(0, len(row_index), _ROWS_AT_ONCE):
            some = slice(first, first + _ROWS_AT_ONCE)
            values[some] = of_network.index_select(0, row_index[some])
        mean = values.sum(0, keepdim=True) / number
        parts.append((mean, values.sub_(mean).square_().sum(0, keepdim=True)))
    means, squares = zip(*parts, strict=True)
    return torch.stack(means), torch.stack(squares)
