"""Minibatch training with compiled kernels: multilayer perceptrons in float32 on a CPU.

`on_policy.updates.policy_kernels` trains policies with it, `on_policy.critics.critic_kernels` critics.
"""

from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from headway_algos.batches.schedule import MinibatchSchedule
from headway_algos.kernels.minibatch_steps import RowIndices
from headway_algos.kernels.perceptron import ACTIVATIONS, Perceptrons, perceptrons
from headway_algos.networks.mlp import StackedMLP
from headway_algos.networks.network import Network
from headway_algos.optim.adam import StackedAdam
from headway_algos.optim.gradient_steps import Steps

ENABLED = True
"""False: torch computes the gradients of minibatches and the Fisher products, for comparison. Forward passes
without gradients, tanh, Adam's steps, GAE and statistics stay compiled."""


def kernel_networks(network: Network, optimiser: StackedAdam) -> Perceptrons | None:
    """Return the arrays of networks and optimiser for kernels, or None if torch is to be used."""
    return kernel_networks_at(network, optimiser.values.whole, optimiser.gradient.whole, optimiser.starts)


def kernel_networks_at(
    network: Network,
    values: Tensor,
    gradient: Tensor,
    starts: Callable[[Iterable[nn.Parameter]], list[int]],
) -> Perceptrons | None:
    """Return the arrays of a stack of networks for kernels, or None if torch is to be used.

    Each parameter begins in `values` and `gradient` (P, V) at the offset that `starts` returns for it.
    """
    supported = not values.is_cuda and values.dtype == torch.float32
    if not (ENABLED and supported) or not isinstance(network, StackedMLP):
        return None
    layers = np.array([(w.shape[2], w.shape[1], *starts((w, b))) for w, b in network.by_layer()])
    return perceptrons(values.numpy(), gradient.numpy(), layers, ACTIVATIONS[network.activation])


def compiled_steps(
    kernel: Callable[..., None],
    networks: Perceptrons,
    optimiser: StackedAdam,
    data: Sequence[Any],
    num_metrics: int,
) -> Steps:
    """Return the steps that a kernel takes on `data`, with `num_metrics` metrics per network."""

    def take_steps(schedule: MinibatchSchedule) -> tuple[Tensor, Tensor]:
        stack = len(networks.values)
        metrics, norms = np.zeros((stack, num_metrics), np.float32), np.zeros(stack, np.float32)
        steps = np.zeros(stack, np.float32)
        for index, sizes in schedule.row_indices():
            kernel(networks, optimiser.kernel_state(), RowIndices(index, sizes), *data, metrics, norms)
            steps += (sizes > 0).sum(axis=0)
        # 0 / 0, where a network took no step, is NaN.
        count = torch.from_numpy(steps)
        return torch.from_numpy(metrics.T) / count, torch.from_numpy(norms) / count

    return take_steps


def as_array(rows: Tensor | None, like: NDArray[Any]) -> NDArray[Any]:
    """Return rows (P, B, ...) as an array (P B, ...) of the dtype of `like` (empty); None: return `like`."""
    if rows is None:
        return like
    array: NDArray[Any] = np.ascontiguousarray(rows.detach().numpy(), dtype=like.dtype)
    return array.reshape(-1, *array.shape[2:])
