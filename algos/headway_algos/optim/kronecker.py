"""Fisher information of a stack of multilayer perceptrons in Kronecker factors (K-FAC: Martens and Grosse
2015, arXiv:1503.05671).

Of a layer with inputs a, a 1 after them for the bias, and signals g = d log p / d (what comes before its
activation), the gradient of log p is g a^T. Its covariance is taken for that of independent factors,

    F = E[(a a^T) x (g g^T)]  ~  A x G,   A = E[a a^T], G = E[g g^T],   (A x G)^-1 vec(M) = vec(G^-1 M A^-1),

and that of different layers for 0. Directions in the parameters are a list of matrices (P, out, in + 1), one
a layer: its weights, then its bias.
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
    """Weights (P, out, in) of all layers, then biases (P, out, 1), as matrices (P, out, in + 1)."""
    layers = len(parameters) // 2
    pairs = zip(parameters[:layers], parameters[layers:], strict=True)
    return [torch.cat(pair, dim=2) for pair in pairs]


def inner(one: Sequence[Tensor], other: Sequence[Tensor]) -> Tensor:
    """Inner products (P,) of two directions."""
    return torch.stack([(a * b).flatten(1).sum(1) for a, b in zip(one, other, strict=True)]).sum(0)


class KroneckerFactors:
    """Running averages of A and G, each network's its own, and the inverses that steps use.

    After the k-th batch a network's averages are max(1 / k, 1 - decay) parts that batch (section 5 of the
    paper). Damping by lambda is factored (section 6.3): (A + pi sqrt(lambda) I) x (G + sqrt(lambda) / pi I),
    where pi^2 = (tr A / size of A) / (tr G / size of G). Inverses are renewed at a network's first batch and
    every `every`-th from there on, in float64.
    """

    def __init__(self, network: StackedMLP, damping: float, decay: float, every: int) -> None:
        self.damping, self.decay, self.every = damping, decay, every
        like = network.weights[0].detach()
        stack, sizes = len(like), [weight.shape[1:] for weight in network.weights]
        self.averages = [like.new_zeros(stack, n, n) for out, in_ in sizes for n in (in_ + 1, out)]
        """A, G of the first layer, A, G of the second ..."""
        self.inverses = [torch.zeros_like(average) for average in self.averages]
        """Of the damped ones; 0, which moves nothing, before the first batch."""
        self.sums = [torch.zeros_like(average) for average in self.averages]
        """Of the batch at hand."""
        self.counts = np.zeros(stack, np.int64)
        """(P,): batches."""

    def begin(self) -> None:
        """A new batch."""
        for total in self.sums:
            total.zero_()

    def include(self, linear: LinearisedMLP, score: Tensor, weight: Tensor) -> None:
        """Add a piece of the batch: d log p / d outputs (P, O, B) of an output drawn from the model in each
        of its rows, whose weights (P, B) sum to 1 over the batch."""
        for i, signal in linear.back(score):
            rows = linear.inputs[i]
            inputs = torch.cat([rows, torch.ones_like(rows[:, :1])], dim=1)
            self.sums[2 * i].baddbmm_(inputs * weight[:, None], inputs.transpose(1, 2))
            self.sums[2 * i + 1].baddbmm_(signal * weight[:, None], signal.transpose(1, 2))

    def absorb(self, active: NDArray[np.bool_]) -> None:
        """Take the batch into the averages of the networks that have rows in it, (P,)."""
        due = active & (self.counts % self.every == 0)
        self.counts[active] += 1
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
            # Where no signal arrives (only one action is allowed) any split of the damping will do.
            ratio = torch.where((ratio > 0) & torch.isfinite(ratio), ratio, 1)[:, None, None]
            for factor, share in ((inputs, ratio), (signals, 1 / ratio)):
                unit = torch.eye(factor.shape[1], dtype=factor.dtype, device=factor.device)
                result.append(factor + share * self.damping**0.5 * unit)
        return result

    def solve(self, gradient: Sequence[Tensor]) -> list[Tensor]:
        """F^-1 times a direction, by the inverses."""
        return _between(self.inverses, gradient)

    def product(self, direction: Sequence[Tensor]) -> list[Tensor]:
        """F times a direction, damped, by the averages as they are now."""
        return _between(self._damped(), direction)

    @property
    def _kept(self) -> list[Tensor]:
        return [*self.averages, *self.inverses]

    def narrow(self, policies: Tensor) -> Self:
        """The same for networks `policies` (n,) alone."""
        part = copy(self)
        part.averages = [tensor[policies] for tensor in self.averages]
        part.inverses = [tensor[policies] for tensor in self.inverses]
        part.sums = [tensor[policies] for tensor in self.sums]
        part.counts = self.counts[policies.cpu().numpy()]
        return part

    def adopt(self, policies: Tensor, part: Self) -> None:
        """Take over what `part`, narrowed to these networks, has become."""
        for mine, theirs in zip(self._kept, part._kept, strict=True):
            mine.index_copy_(0, policies, theirs)
        self.counts[policies.cpu().numpy()] = part.counts

    def state_dict(self) -> dict[str, Any]:
        """Averages, inverses and counts, each with leading axis P."""
        return {
            "averages": self.averages,
            "inverses": self.inverses,
            "counts": torch.from_numpy(self.counts),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Inverse of `state_dict`; a copy, which leaves `state` as it is."""
        for mine, theirs in zip(self._kept, [*state["averages"], *state["inverses"]], strict=True):
            mine.copy_(theirs)
        self.counts[:] = state["counts"].cpu().numpy()


def _between(factors: Sequence[Tensor], direction: Sequence[Tensor]) -> list[Tensor]:
    """G M A of each layer."""
    each = zip(factors[::2], factors[1::2], direction, strict=True)
    return [signals @ matrix @ inputs for inputs, signals, matrix in each]


def _inverse(matrices: Tensor) -> Tensor:
    """Of positive definite matrices (n, size, size). What is not finite gives what is not finite, which the
    learner refuses in one line."""
    triangular, _ = torch.linalg.cholesky_ex(matrices.double())
    return torch.cholesky_inverse(triangular).to(matrices.dtype)
