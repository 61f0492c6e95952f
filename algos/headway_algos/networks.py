"""P networks of one form as one: every tensor has a leading axis P, every layer is one batched product.

Weights are (P, out, in) and activations (P, features, rows): with rows last, the narrow output layer's
products and all elementwise work run along contiguous memory (the layer 64 -> 3 was measured at 44 us
for 10 x 512 rows, 240 us with rows first).
"""

from collections import deque
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from headway.contracts import generator
from headway_algos.acting import layer_sizes


def orthogonal(random: np.random.Generator, rows: int, columns: int, gain: float) -> NDArray[np.float64]:
    """A matrix with orthonormal rows or columns, times `gain` (Saxe et al., arXiv:1312.6120)."""
    tall = random.standard_normal((max(rows, columns), min(rows, columns)))
    q, r = np.linalg.qr(tall)
    q *= np.sign(np.diag(r))
    return gain * (q if rows >= columns else q.T)


class _TanhLayer(torch.autograd.Function):
    """tanh(W x + b) with numpy's tanh, which took 51 us where torch's took 676 (one thread, AVX-512)."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, weight: Tensor, bias: Tensor) -> Tensor:  # noqa: ANN401 - torch's own
        h = torch.bmm(weight, x).add_(bias)
        array = h.numpy()
        np.tanh(array, out=array)
        ctx.save_for_backward(x, weight, h)
        return h

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, Tensor, Tensor]:  # noqa: ANN401
        x, weight, h = ctx.saved_tensors
        gradient = torch.ops.aten.tanh_backward(gradients[0], h)
        of_x = torch.bmm(weight.transpose(1, 2), gradient) if ctx.needs_input_grad[0] else None
        return of_x, torch.bmm(gradient, x.transpose(1, 2)), gradient.sum(2, keepdim=True)


def tanh_layer(x: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
    """tanh(W x + b): x (P, in, rows), weight (P, out, in), bias (P, out, 1) -> (P, out, rows)."""
    if x.is_cuda:
        return torch.baddbmm(bias, weight, x).tanh()
    result: Tensor = _TanhLayer.apply(x, weight, bias)  # type: ignore[no-untyped-call]  # torch leaves it untyped
    return result


class StackedMLP(nn.Module):
    """P multilayer perceptrons. Policy p of replica r is initialised from (seeds[r], purpose, k, layer)
    alone, so it is the same in any stack."""

    def __init__(
        self,
        seeds: Sequence[int],
        networks_per_seed: int,
        purpose: str,
        sizes: tuple[int, Sequence[int], int],
        activation: str,
        last_gain: float,
        dtype: torch.dtype,
    ) -> None:
        super().__init__()
        self.activation = activation
        self.weights, self.biases = nn.ParameterList(), nn.ParameterList()
        layers = layer_sizes(*sizes)
        hidden_gain = 5 / 3 if activation == "tanh" else 2**0.5
        for i, (out, in_) in enumerate(layers):
            gain = hidden_gain if i < len(layers) - 1 else last_gain
            stack = [
                orthogonal(generator(seed, purpose, k, i), out, in_, gain)
                for seed in seeds
                for k in range(networks_per_seed)
            ]
            self.weights.append(nn.Parameter(torch.tensor(np.stack(stack), dtype=dtype)))
            self.biases.append(nn.Parameter(torch.zeros(len(stack), out, 1, dtype=dtype)))

    def forward(self, rows: Tensor) -> Tensor:
        """(P, B, in) -> (P, out, B)."""
        # Each layer's result is freed as soon as the next one has it.
        return deque(self.layers(rows), maxlen=1).pop()

    def layers(self, rows: Tensor) -> Iterator[Tensor]:
        """What every layer is given, (P, features, B), then the outputs."""
        x = rows.transpose(1, 2)
        last = len(self.weights) - 1
        for i, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            yield x
            if i == last:
                x = torch.bmm(weight, x) + bias
            elif self.activation == "tanh":
                x = tanh_layer(x, weight, bias)
            else:
                x = torch.baddbmm(bias, weight, x).relu()
        yield x
