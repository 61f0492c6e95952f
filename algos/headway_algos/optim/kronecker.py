"""Kronecker-factored Fisher information (K-FAC) of stacked multilayer perceptrons.

Source: Martens and Grosse 2015, arXiv:1503.05671. For a layer with inputs a (extended by 1 for the bias) and
signals g = d log p / d (pre-activation), the gradient of log p is g a^T. Its covariance is approximated by
that of independent factors,

    F = E[(a a^T) x (g g^T)]  ~  A x G,   A = E[a a^T], G = E[g g^T],   (A x G)^-1 vec(M) = vec(G^-1 M A^-1),

and covariances between layers by 0. Directions are lists of matrices (P, out, in + 1), one per layer: its
weights, then its bias.
"""

from collections.abc import Sequence
from copy import copy
from typing import Any, Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from headway_algos.networks.linearised import LinearisedMLP
from headway_algos.networks.mlp import StackedMLP


def joined(parameters: Sequence[Tensor]) -> list[Tensor]:
    """Join weights (P, out, in) of all layers, then biases (P, out, 1), to matrices (P, out, in + 1)."""
    layers = len(parameters) // 2
    pairs = zip(parameters[:layers], parameters[layers:], strict=True)
    return [torch.cat(pair, dim=2) for pair in pairs]


def inner(one: Sequence[Tensor], other: Sequence[Tensor]) -> Tensor:
    """Return the inner products (P,) of two directions."""
    return torch.stack([(a * b).flatten(1).sum(1) for a, b in zip(one, other, strict=True)]).sum(0)


class KroneckerFactors:
    """Running averages of A and G per network, and their damped inverses.

    The k-th batch of a network enters its averages with weight max(1 / k, 1 - decay) (section 5 of the
    paper). Damping by lambda is factored (section 6.3): (A + pi sqrt(lambda) I) x (G + sqrt(lambda) / pi I),
    where pi^2 = (tr A / size of A) / (tr G / size of G). Inverses are computed in float64, at a network's
    first batch and every `every`-th from there on.
    """

    def __init__(self, network: StackedMLP, damping: float, decay: float, every: int) -> None:
        self.damping, self.decay, self.every = damping, decay, every
        like = network.weights[0].detach()
        stack, sizes = len(like), [weight.shape[1:] for weight in network.weights]
        self.averages = [like.new_zeros(stack, n, n) for out, in_ in sizes for n in (in_ + 1, out)]
        """A, G of the first layer, A, G of the second ..."""
        self.inverses = [torch.zeros_like(average) for average in self.averages]
        """Inverses of the damped averages; 0 before the first batch."""
        self.sums = [torch.zeros_like(average) for average in self.averages]
        """A and G of the current batch."""
        self.counts = np.zeros(stack, np.int64)
        """(P,): number of batches."""

    def begin(self) -> None:
        """Start a new batch."""
        for total in self.sums:
            total.zero_()

    def include(self, linear: LinearisedMLP, score: Tensor, weight: Tensor) -> None:
        """Add a piece of the batch, with row weights (P, B) that sum to 1 over the batch.

        `score` (P, O, B) is d log p / d outputs, for one sample from the model's distribution per row.
        """
        for i, signal in linear.back(score):
            rows = linear.inputs[i]
            inputs = torch.cat([rows, torch.ones_like(rows[:, :1])], dim=1)
            self.sums[2 * i].baddbmm_(inputs * weight[:, None], inputs.transpose(1, 2))
            self.sums[2 * i + 1].baddbmm_(signal * weight[:, None], signal.transpose(1, 2))

    def absorb(self, active: NDArray[np.bool_]) -> None:
        """Update the averages of the `active` (P,) networks, those with rows in the batch."""
        due = active & (self.counts % self.every == 0)
        self.counts[active] += 1
        # The first batches count equally: with a fixed decay the initial zeros would dominate.
        share = np.where(active, np.maximum(1 / np.maximum(self.counts, 1), 1 - self.decay), 0)
        part = torch.from_numpy(share).to(self.averages[0])[:, None, None]
        for average, total in zip(self.averages, self.sums, strict=True):
            average.lerp_(total, part)
        if due.any():
            index = torch.from_numpy(np.flatnonzero(due)).to(part.device)
            for inverse, damped in zip(self.inverses, self._damped(), strict=True):
                inverse.index_copy_(0, index, _inverse(damped[index]))

    def _damped(self) -> list[Tensor]:
        result = []
        for inputs, signals in zip(self.averages[::2], self.averages[1::2], strict=True):
            means = [f.diagonal(dim1=1, dim2=2).mean(1) for f in (inputs, signals)]
            ratio = (means[0] / means[1]).sqrt()
            # If all signals are 0 (only one action is allowed), any split of the damping will do.
            ratio = torch.where((ratio > 0) & torch.isfinite(ratio), ratio, 1)[:, None, None]
            for factor, share in ((inputs, ratio), (signals, 1 / ratio)):
                unit = torch.eye(factor.shape[1], dtype=factor.dtype, device=factor.device)
                result.append(factor + share * self.damping**0.5 * unit)
        return result

    def solve(self, gradient: Sequence[Tensor]) -> list[Tensor]:
        """Return F^-1 times a direction, by the stored inverses."""
        return _between(self.inverses, gradient)

    def product(self, direction: Sequence[Tensor]) -> list[Tensor]:
        """Return the damped F times a direction, by the current averages."""
        return _between(self._damped(), direction)

    @property
    def _kept(self) -> list[Tensor]:
        return [*self.averages, *self.inverses]

    def narrow(self, policies: Tensor) -> Self:
        """Return the factors of networks `policies` (n,)."""
        part = copy(self)
        part.averages = [tensor[policies] for tensor in self.averages]
        part.inverses = [tensor[policies] for tensor in self.inverses]
        part.sums = [tensor[policies] for tensor in self.sums]
        part.counts = self.counts[policies.cpu().numpy()]
        return part

    def adopt(self, policies: Tensor, part: Self) -> None:
        """Copy the factors of networks `policies` (n,) from `part`, a result of `narrow`."""
        for mine, theirs in zip(self._kept, part._kept, strict=True):
            mine.index_copy_(0, policies, theirs)
        self.counts[policies.cpu().numpy()] = part.counts

    def state_dict(self) -> dict[str, Any]:
        """Return averages, inverses and counts, each with leading axis P."""
        return {
            "averages": self.averages,
            "inverses": self.inverses,
            "counts": torch.from_numpy(self.counts),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore the result of `state_dict`, by copying."""
        for mine, theirs in zip(self._kept, [*state["averages"], *state["inverses"]], strict=True):
            mine.copy_(theirs)
        self.counts[:] = state["counts"].cpu().numpy()


def _between(factors: Sequence[Tensor], direction: Sequence[Tensor]) -> list[Tensor]:
    """Return G M A for each layer."""
    each = zip(factors[::2], factors[1::2], direction, strict=True)
    return [signals @ matrix @ inputs for inputs, signals, matrix in each]


def _inverse(matrices: Tensor) -> Tensor:
    """Return the inverses of positive definite matrices (n, size, size); not finite where a matrix is not.

    Learners report parameters that are not finite as divergence.
    """
    triangular, _ = torch.linalg.cholesky_ex(matrices.double())
    return torch.cholesky_inverse(triangular).to(matrices.dtype)
