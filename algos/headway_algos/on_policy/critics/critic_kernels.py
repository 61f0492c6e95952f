"""Minibatch steps of critics by compiled kernels: perceptrons in float32 on a CPU."""

import numpy as np
from torch import Tensor

from headway_algos.kernels.minibatch_steps import Targets, descend_returns
from headway_algos.networks.network import Network
from headway_algos.optim.adam import StackedAdam
from headway_algos.optim.fast_path import as_array, compiled_steps, kernel_networks
from headway_algos.optim.gradient_steps import Optimiser, Steps


def compiled_critic_steps(
    network: Network,
    optimiser: Optimiser,
    inputs: Tensor,
    taken: Tensor | None,
    targets: Tensor,
    value_clip: float | None,
) -> Steps | None:
    """Return the steps that minimise `squared_error` by compiled kernels, or None to take them by autograd.

    Arguments are inputs (P, B, D), the index (P, B) of the trained output (None with one output) and targets
    (P, B). The metric is the loss.
    """
    if not isinstance(optimiser, StackedAdam) or (networks := kernel_networks(network, optimiser)) is None:
        return None
    numbers = np.empty(0, np.float32)
    bound = float("inf") if value_clip is None else float(value_clip)
    data = Targets(
        as_array(inputs, numbers), as_array(taken, np.empty(0, np.int64)), as_array(targets, numbers), bound
    )
    return compiled_steps(descend_returns, networks, optimiser, (data,), 1)
