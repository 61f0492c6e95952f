"""Running means and standard deviations, one for each of a stack of networks."""

import torch
from torch import Tensor, nn

from headway_algos.acting import OBSERVATION_CLIP


class RunningMoments(nn.Module):
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

    def include(self, rows: Tensor, selected: Tensor | None = None) -> None:
        """Add rows (P, B, size) where `selected` (P, B) holds."""
        if selected is None or bool(selected.all()):
            values = rows.double()
            count = torch.full_like(self.count, rows.shape[1])
            mean = values.mean(1, keepdim=True)
            squares = ((values - mean) ** 2).sum(1, keepdim=True)
        else:
            # Network by network: where most rows are of agents that are absent, a sum over all costs most.
            parts = [_moments(each[which].double()) for each, which in zip(rows, selected, strict=True)]
            count = selected.sum(1).double()[:, None, None]
            mean, squares = (torch.stack(of_all) for of_all in zip(*parts, strict=True))
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
        scaled = (rows - self.mean.to(rows.dtype)) * self.scale.to(rows.dtype)
        return scaled.clamp_(-OBSERVATION_CLIP, OBSERVATION_CLIP)

    @property
    def scale(self) -> Tensor:
        """1 / standard deviation, (P, 1, size)."""
        return torch.rsqrt(self.variance + 1e-8)

    @property
    def std(self) -> Tensor:
        """Standard deviation, (P, 1, size)."""
        return torch.sqrt(self.variance + 1e-8)


def _moments(rows: Tensor) -> tuple[Tensor, Tensor]:
    """Mean and summed squared deviations from it, (1, size) each, of rows (B, size); 0 of none."""
    mean = rows.sum(0, keepdim=True) / max(len(rows), 1)
    return mean, ((rows - mean) ** 2).sum(0, keepdim=True)
