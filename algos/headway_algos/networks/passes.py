"""Passes through a stack of networks, to learn from: outputs forward, and a loss's slope there backward.

For multilayer perceptrons both are written out: recording each operation, as torch does to differentiate
whatever it was, takes longer than the operations do where minibatches are small.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor, nn

from headway_algos.networks.gru import Network, RecurrentNetwork
from headway_algos.networks.linearised import LinearisedMLP
from headway_algos.networks.mlp import StackedMLP
from headway_algos.networks.timeline import Timeline


class Pass(Protocol):
    """P networks at rows of their own."""

    @property
    def outputs(self) -> Tensor:
        """(P, A, B), a constant to torch."""
        ...

    def send_back(self, slope: Tensor) -> None:
        """Add to the gradients of the networks' parameters those of a loss of which d loss / d outputs is
        given, (P, A, B)."""
        ...


def add_gradients(parameters: Iterable[nn.Parameter], gradients: Iterable[Tensor]) -> None:
    """Add to the parameters' gradients, as torch's backpropagation does."""
    for parameter, gradient in zip(parameters, gradients, strict=True):
        parameter.grad = gradient if parameter.grad is None else parameter.grad.add_(gradient)


@dataclass(frozen=True)
class PerceptronPass:
    """Through multilayer perceptrons."""

    network: StackedMLP
    linear: LinearisedMLP

    @property
    def outputs(self) -> Tensor:
        return self.linear.outputs

    def send_back(self, slope: Tensor) -> None:
        weights, biases = zip(*self.network.by_layer(), strict=True)
        add_gradients(weights + biases, self.linear.vjp(slope))


@dataclass(frozen=True)
class _RecordedPass:
    recorded: Tensor

    @property
    def outputs(self) -> Tensor:
        return self.recorded.detach()

    def send_back(self, slope: Tensor) -> None:
        torch.autograd.backward(self.recorded, slope)


def forward_pass(network: Network, rows: Tensor, timeline: Timeline | None) -> Pass:
    """Of rows (P, B, D), for networks that remember in the order of a timeline."""
    if isinstance(network, RecurrentNetwork):
        return _RecordedPass(network(rows, timeline))
    return PerceptronPass(network, LinearisedMLP.of(network, rows))
