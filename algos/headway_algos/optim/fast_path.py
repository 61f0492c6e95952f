"""Minibatch training with compiled kernels: multilayer perceptrons in float32 on a CPU.

The losses of policies are in `on_policy.updates.compiled_losses`, the regression of critics is in
`on_policy.critics.compiled_regression`.
"""

from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from headway_algos.networks.mlp import StackedMLP
from headway_algos.networks.network import Network
from headway_algos.optim.adam import StackedAdam

if TYPE_CHECKING:
    from headway_algos.kernels import Perceptrons

RowIndices = Iterable[tuple[NDArray[np.int64], NDArray[np.int64]]]
"""Results of `batches.minibatches.shuffled_epochs`."""
Descent = Callable[[RowIndices], tuple[Tensor, Tensor]]
"""Takes one step per minibatch; returns means over a network's steps: of the I reported numbers, (I, P), and
of the gradient's norm, (P,); NaN for a network that took none."""

ENABLED = True
"""False: gradients of minibatches and Fisher products by torch, so that tests and benchmarks can compare;
Adam's steps and tanh remain compiled."""


def perceptrons_of(network: Network, optimiser: StackedAdam) -> "Perceptrons | None":
    """Return the arrays of networks and optimiser for kernels, or None if torch is to be used."""
    return perceptrons_in(network, optimiser.values.whole, optimiser.gradient.whole, optimiser.starts)


def perceptrons_in(
    network: Network,
    values: Tensor,
    gradient: Tensor,
    starts: Callable[[Iterable[nn.Parameter]], list[int]],
) -> "Perceptrons | None":
    """Return the arrays of a stack of networks for kernels, or None if torch is to be used.

    `values` and `gradient` (P, V) hold the parameters from the offsets on that `starts` returns.
    """
    supported = not values.is_cuda and values.dtype == torch.float32
    if not (ENABLED and supported) or not isinstance(network, StackedMLP):
        return None
    from headway_algos.kernels import perceptrons

    layers = np.array([(w.shape[2], w.shape[1], *starts((w, b))) for w, b in network.by_layer()])
    return perceptrons(values.numpy(), gradient.numpy(), layers, network.activation == "relu")


def descent(
    kernel: Callable[..., None],
    networks: "Perceptrons",
    optimiser: StackedAdam,
    data: Sequence[Any],
    reports: int,
) -> Descent:
    """Return the steps that a kernel takes on `data`, with `reports` numbers per network."""

    def descend(epochs: RowIndices) -> tuple[Tensor, Tensor]:
        from headway_algos.kernels import Minibatches

        stack = len(networks.values)
        reported, norms = np.zeros((stack, reports), np.float32), np.zeros(stack, np.float32)
        steps = np.zeros(stack, np.float32)
        for index, sizes in epochs:
            kernel(networks, optimiser.kernel_state(), Minibatches(index, sizes), *data, reported, norms)
            steps += (sizes > 0).sum(axis=0)
        # 0 / 0, where a network took no step, is NaN.
        count = torch.from_numpy(steps)
        return torch.from_numpy(reported.T) / count, torch.from_numpy(norms) / count

    return descend


def as_array(rows: Tensor | None, like: NDArray[Any]) -> NDArray[Any]:
    """Return rows (P, B, ...) as an array (P B, ...) with the dtype of the empty array `like`, or `like`."""
    if rows is None:
        return like
    array: NDArray[Any] = np.ascontiguousarray(rows.detach().numpy(), dtype=like.dtype)
    return array.reshape(-1, *array.shape[2:])
