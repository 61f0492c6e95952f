"""Forward and backward passes through stacked networks, for training.

For multilayer perceptrons both are written out: with small minibatches, recording operations for autograd
takes longer than the operations themselves.
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
    """A forward pass of P networks, each on its own rows."""

    @property
    def outputs(self) -> Tensor:
        """(P, A, B), detached from the autograd graph."""
        ...

    def send_back(self, slope: Tensor) -> None:
        """Add a loss's gradients to those of the networks' parameters, given d loss / d outputs (P, A, B)."""
        ...


def add_gradients(parameters: Iterable[nn.Parameter], gradients: Iterable[Tensor]) -> None:
    """Accumulate gradients into the parameters, as torch's backpropagation does."""
    for parameter, gradient in zip(parameters, gradients, strict=True):
        parameter.grad = gradient if parameter.grad is None else parameter.grad.add_(gradient)


@dataclass(frozen=True)
class PerceptronPass:
    """A pass through multilayer perceptrons."""

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
    """Run networks on rows (P, B, D); recurrent networks need a timeline."""
    if isinstance(network, RecurrentNetwork):
        return _RecordedPass(network(rows, timeline))
    return PerceptronPass(network, LinearisedMLP.of(network, rows))
