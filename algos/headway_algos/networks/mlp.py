"""Stacked multilayer perceptrons: tensors have a leading axis P, and each layer is one batched product.

Weights are (P, out, in), activations (P, features, rows). With rows last, elementwise operations and the
narrow products of the output layer run along contiguous memory: a layer 64 -> 3 on 10 x 512 rows took 44 us,
against 240 us with rows first.
"""

from collections import deque
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from headway.contracts import generator
from headway_algos.acting.mlp import layer_sizes
from headway_algos.kernels.perceptron import TANH, activate_stack, evaluate
from headway_algos.networks.timeline import Timeline

HIDDEN_GAIN = {"tanh": 5 / 3, "relu": 2**0.5}
"""Gain of a hidden layer's orthogonal initialisation, by activation."""


def orthogonal(random: np.random.Generator, rows: int, columns: int, gain: float) -> NDArray[np.float64]:
    """Draw a matrix with orthonormal rows or columns, times `gain` (Saxe et al. 2014, arXiv:1312.6120)."""
    tall = random.standard_normal((max(rows, columns), min(rows, columns)))
    q, r = np.linalg.qr(tall)
    q *= np.sign(np.diag(r))
    return gain * (q if rows >= columns else q.T)


def _tanh_of_affine(x: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
    """Return tanh(W x + b) on a CPU, by kernel or numpy: torch's own tanh takes ten times as long."""
    h = torch.bmm(weight, x)
    if h.dtype == torch.float32:
        activate_stack(h.numpy(), np.ascontiguousarray(bias.detach()[..., 0].numpy()), TANH)
        return h
    array = h.add_(bias).numpy()
    np.tanh(array, out=array)
    return h


class _TanhLayer(torch.autograd.Function):
    """Differentiable version of `_tanh_of_affine`."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, weight: Tensor, bias: Tensor) -> Tensor:  # noqa: ANN401 - torch's own
        h = _tanh_of_affine(x, weight, bias)
        ctx.save_for_backward(x, weight, h)
        return h

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, Tensor, Tensor]:  # noqa: ANN401
        x, weight, h = ctx.saved_tensors
        gradient = torch.ops.aten.tanh_backward(gradients[0], h)
        of_x = torch.bmm(weight.transpose(1, 2), gradient) if ctx.needs_input_grad[0] else None
        return of_x, torch.bmm(gradient, x.transpose(1, 2)), gradient.sum(2, keepdim=True)


def tanh_layer(x: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
    """Return tanh(W x + b), (P, out, rows), for x (P, in, rows), weight (P, out, in), bias (P, out, 1)."""
    if x.is_cuda:
        return torch.baddbmm(bias, weight, x).tanh()
    if not torch.is_grad_enabled():
        return _tanh_of_affine(x, weight, bias)
    result: Tensor = _TanhLayer.apply(x, weight, bias)  # type: ignore[no-untyped-call]  # torch leaves it untyped
    return result


def _relu_layer(x: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
    return torch.baddbmm(bias, weight, x).relu()


_LAYERS = {"tanh": tanh_layer, "relu": _relu_layer}


def activated_layer(x: Tensor, weight: Tensor, bias: Tensor, activation: str) -> Tensor:
    """Return activation(W x + b), with the shapes of `tanh_layer`."""
    return _LAYERS[activation](x, weight, bias)


def stacked_matrices(
    seeds: Sequence[int],
    networks_per_seed: int,
    purpose: str,
    layer: int,
    shape: tuple[int, int],
    gain: float,
    dtype: torch.dtype,
) -> nn.Parameter:
    """Return orthogonal matrices (P, rows, columns) as a parameter.

    Network k of replica r depends on (seeds[r], purpose, k, layer) only, so it is the same in any stack.
    """
    stack = [
        orthogonal(generator(seed, purpose, k, layer), *shape, gain)
        for seed in seeds
        for k in range(networks_per_seed)
    ]
    return nn.Parameter(torch.tensor(np.stack(stack), dtype=dtype))


class StackedMLP(nn.Module):
    """P multilayer perceptrons, initialised by `stacked_matrices`."""

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
        hidden_gain = HIDDEN_GAIN[activation]
        for i, (out, in_) in enumerate(layers):
            gain = hidden_gain if i < len(layers) - 1 else last_gain
            shape = (out, in_)
            self.weights.append(stacked_matrices(seeds, networks_per_seed, purpose, i, shape, gain, dtype))
            self.biases.append(nn.Parameter(torch.zeros(len(self.weights[i]), out, 1, dtype=dtype)))

    def by_layer(self) -> list[tuple[nn.Parameter, nn.Parameter]]:
        """Return weight and bias of each layer."""
        # Indexing a ParameterList looks up the index as a string, which takes as long as a small product.
        pairs = zip(self.weights._parameters.values(), self.biases._parameters.values(), strict=True)
        return [(weight, bias) for weight, bias in pairs if weight is not None and bias is not None]

    def forward(self, rows: Tensor, timeline: Timeline | None = None) -> Tensor:
        """Return outputs (P, out, B) for rows (P, B, in); `timeline` is ignored."""
        if not (torch.is_grad_enabled() or rows.is_cuda) and rows.dtype == torch.float32:
            layers = [(weight.detach().numpy(), bias.detach().numpy()) for weight, bias in self.by_layer()]
            return torch.from_numpy(evaluate(layers, rows.numpy(), self.activation))
        # Activations are freed as soon as the next layer has used them.
        return deque(self.layers(rows), maxlen=1).pop()

    def layers(self, rows: Tensor) -> Iterator[Tensor]:
        """Yield the inputs of each layer, (P, features, B), then the outputs."""
        x = rows.transpose(1, 2)
        by_layer = self.by_layer()
        last = len(by_layer) - 1
        for i, (weight, bias) in enumerate(by_layer):
            yield x
            if i == last:
                x = torch.bmm(weight, x) + bias
            else:
                x = activated_layer(x, weight, bias, self.activation)
        yield x
