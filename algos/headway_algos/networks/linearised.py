"""Jacobian products of stacked multilayer perceptrons, at fixed parameters theta and rows x.

With J = d network(x) / d theta, `jvp` returns J v by forward differentiation, layer by layer (Pearlmutter
1994, "Fast Exact Multiplication by the Hessian"), and `vjp` returns J^T u by backpropagation. Both reuse the
stored activations and do not evaluate the network again.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Self

import torch
from torch import Tensor

from headway_algos.networks.mlp import StackedMLP

_BACKWARD: dict[str, Callable[[Tensor, Tensor], Tensor]] = {
    "tanh": torch.ops.aten.tanh_backward,
    "relu": lambda signal, activated: torch.ops.aten.threshold_backward(signal, activated, 0),
}
"""(signal, activated values) -> signal times the derivative of the activation."""


@dataclass(frozen=True)
class LinearisedMLP:
    """P networks linearised at given rows.

    Directions and gradients are in the order of the parameters: weights (P, out, in) of all layers, then
    biases (P, out, 1).
    """

    weights: tuple[Tensor, ...]
    inputs: tuple[Tensor, ...]
    """Inputs of each layer, (P, in, B)."""
    outputs: Tensor
    """(P, A, B)"""
    activation: str

    @classmethod
    def of(cls, network: StackedMLP, rows: Tensor) -> Self:
        """Linearise at the network's current parameters and rows (P, B, D)."""
        with torch.no_grad():
            *inputs, outputs = network.layers(rows)
        weights = tuple(weight.detach() for weight, _ in network.by_layer())
        return cls(weights, tuple(inputs), outputs, network.activation)

    def _through(self, layer: int, signal: Tensor) -> Tensor:
        """Multiply a signal by the derivative of the activation that precedes `layer`."""
        return _BACKWARD[self.activation](signal, self.inputs[layer])

    def jvp(self, direction: Sequence[Tensor]) -> Tensor:
        """Return J v, (P, A, B): the derivative of the outputs along a direction in parameter space."""
        layers = len(self.weights)
        change = torch.baddbmm(direction[layers], direction[0], self.inputs[0])
        for i in range(1, layers):
            before = self._through(i, change)
            change = torch.baddbmm(direction[layers + i], direction[i], self.inputs[i])
            change = change.baddbmm_(self.weights[i], before)
        return change

    def back(self, signal: Tensor) -> Iterator[tuple[int, Tensor]]:
        """Backpropagate u (P, A, B) and yield each layer, last to first, with its signal before activation.

        Signals are (P, out, B).
        """
        for i in reversed(range(len(self.weights))):
            yield i, signal
            if i > 0:
                signal = self._through(i, torch.bmm(self.weights[i].transpose(1, 2), signal))

    def vjp(self, signal: Tensor) -> list[Tensor]:
        """Return J^T u summed over rows, for each parameter, given u (P, A, B)."""
        weight_gradients, bias_gradients = [], []
        for i, arrived in self.back(signal):
            weight_gradients.append(torch.bmm(arrived, self.inputs[i].transpose(1, 2)))
            bias_gradients.append(arrived.sum(2, keepdim=True))
        return weight_gradients[::-1] + bias_gradients[::-1]
