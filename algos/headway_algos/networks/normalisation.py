"""Running means and standard deviations, one set per network of a stack."""

from math import inf
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from headway_algos.acting.mlp import OBSERVATION_CLIP
from headway_algos.kernels.moments import write_moments


class RunningStatistics(nn.Module):
    """Mean and variance of the rows included so far, (P, 1, size) each, float64.

    Combined by the parallel formula of Chan, Golub and LeVeque (1979). The mean starts at 0; the variance is
    1 until two rows have been included. Stored as buffers, so that checkpoints contain them.

    When a batch is included, the total weight of all earlier ones is limited to the largest of `memory` rows,
    `batches` times the new batch's rows, and `share` times all rows so far: old batches are forgotten.
    """

    count: Tensor
    """(P, 1, 1): total weight."""
    rows: Tensor
    """(P, 1, 1): number of rows so far."""
    mean: Tensor
    variance: Tensor

    def __init__(
        self, stack: int, size: int, memory: float = inf, batches: float = 0.0, share: float = 0.0
    ) -> None:
        super().__init__()
        self.memory, self.batches, self.share = memory, batches, share
        self.register_buffer("count", torch.zeros(stack, 1, 1, dtype=torch.float64))
        self.register_buffer("rows", torch.zeros(stack, 1, 1, dtype=torch.float64), persistent=share > 0)
        self.register_buffer("mean", torch.zeros(stack, 1, size, dtype=torch.float64))
        self.register_buffer("variance", torch.ones(stack, 1, size, dtype=torch.float64))
        self.latest: tuple[Tensor, Tensor, Tensor] | None = None
        """Count (P, 1, 1), mean and sum of squared deviations (P, 1, size) of the last batch included."""

    def include(self, rows: Tensor, selected: NDArray[np.bool_] | None = None) -> None:
        """Include rows (P, B, size) where `selected` (P, B) is true; other rows may have any values."""
        chosen = np.ones(rows.shape[:2], np.bool_) if selected is None else selected
        count = torch.from_numpy(chosen.sum(axis=1, keepdims=True)[..., None]).to(rows.device).double()
        if rows.is_cuda:
            mean, squares = _deviations(rows, chosen, count.clamp(min=1))
        else:
            mean, squares = torch.empty_like(self.mean), torch.empty_like(self.variance)
            chosen, results = np.ascontiguousarray(chosen), (mean[:, 0].numpy(), squares[:, 0].numpy())
            write_moments(rows.contiguous().numpy(), chosen, *results)
        self.latest = count, mean, squares
        self.add(count, mean, squares)

    def add(self, count: Tensor, mean: Tensor, squares: Tensor) -> None:
        """Include a batch, given its count (P, 1, 1), mean and sum of squared deviations (P, 1, size)."""
        bound = torch.maximum(self.batches * count, self.share * self.rows).clamp(min=self.memory)
        known = torch.minimum(self.count, bound)
        total = known + count
        share = count / total.clamp(min=1)
        shift = mean - self.mean
        old_squares = torch.where(known > 1, self.variance * known, 0)
        new_squares = old_squares + squares + shift**2 * known * share
        self.mean += shift * share
        self.variance = torch.where(total > 1, new_squares / total.clamp(min=1), self.variance)
        self.count, self.rows = total, self.rows + count

    def pool(self, groups: NDArray[np.int64]) -> None:
        """Give each network the statistics of all rows of the networks in its group; groups (P,)."""
        for group in np.unique(groups):
            members = torch.from_numpy(np.flatnonzero(groups == group)).to(self.mean.device)
            if len(members) > 1:
                self._pool(members)

    def _pool(self, members: Tensor) -> None:
        counts, means = self.count[members], self.mean[members]
        total = counts.sum(0)
        mean = (means * counts).sum(0) / total.clamp(min=1)
        squares = torch.where(counts > 1, self.variance[members] * counts, 0) + (means - mean) ** 2 * counts
        self.mean[members] = mean
        if total > 1:
            self.variance[members] = squares.sum(0) / total
        self.count[members], self.rows[members] = total, self.rows[members].sum(0)

    def _load_from_state_dict(self, state: dict[str, Any], prefix: str, *more: object) -> None:
        """Use `count` for `rows` in states stored without `rows`."""
        if self.share > 0:
            state.setdefault(f"{prefix}rows", state[f"{prefix}count"])
        super()._load_from_state_dict(state, prefix, *more)

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
