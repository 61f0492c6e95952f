"""A stack of multilayer perceptrons near its parameters: outputs to first order in the parameters.

For rows x and parameters theta, J = d network(x) / d theta. `push` gives J v by forward differentiation, a
layer at a time (Pearlmutter 1994, "Fast Exact Multiplication by the Hessian"), and `pull` gives J^T u as
backpropagation does. The activations are kept, so that neither evaluates the network again.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Self

import torch
from torch import Tensor

from headway_algos.networks.mlp import StackedMLP


@dataclass(frozen=True)
class LinearisedMLP:
    """P networks at rows of their own. Directions and gradients are in the order of the parameters: the
    weights (P, out, in) of all layers, then the biases (P, out, 1)."""

    weights: tuple[Tensor, ...]
    inputs: tuple[Tensor, ...]
    """What each layer is given, (P, in, B)."""
    outputs: Tensor
    """(P, A, B)"""
    activation: str

    @classmethod
    def of(cls, network: StackedMLP, rows: Tensor) -> Self:
        """At the network's parameters and rows (P, B, D)."""
        with torch.no_grad():
            *inputs, outputs = network.layers(rows)
        weights = tuple(weight.detach() for weight, _ in network.by_layer())
        return cls(weights, tuple(inputs), outputs, network.activation)

    def _through(self, layer: int, signal: Tensor) -> Tensor:
        """A signal times the slope of the activation that made the input of `layer`."""
        activated = self.inputs[layer]
        aten = torch.ops.aten
        if self.activation == "tanh":
            changed: Tensor = aten.tanh_backward(signal, activated)
        else:
            changed = aten.threshold_backward(signal, activated, 0)
        return changed

    def jvp(self, direction: Sequence[Tensor]) -> Tensor:
        """J v, (P, A, B): how outputs change along a direction in the parameters."""
        layers = len(self.weights)
        change = torch.baddbmm(direction[layers], direction[0], self.inputs[0])
        for i in range(1, layers):
            before = self._through(i, change)
            change = torch.baddbmm(direction[layers + i], direction[i], self.inputs[i])
            change = change.baddbmm_(self.weights[i], before)
        return change

    def back(self, signal: Tensor) -> Iterator[tuple[int, Tensor]]:
        """Each layer from the last one to the first, with what of a signal u (P, A, B) at the outputs arrives
        before its activation, (P, out, B)."""
        for i in reversed(range(len(self.weights))):
            yield i, signal
            if i > 0:
                signal = self._through(i, torch.bmm(self.weights[i].transpose(1, 2), signal))

    def vjp(self, signal: Tensor) -> list[Tensor]:
        """J^T u summed over rows, for each parameter, from a signal u (P, A, B)."""
        of_weights, of_biases = [], []
        for i, arrived in self.back(signal):
            of_weights.append(torch.bmm(arrived, self.inputs[i].transpose(1, 2)))
            of_biases.append(arrived.sum(2, keepdim=True))
        return of_weights[::-1] + of_biases[::-1]
