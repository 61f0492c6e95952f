"""Regression of critics on returns with compiled kernels: perceptrons in float32 on a CPU."""

import numpy as np
from torch import Tensor

from headway_algos.networks.network import Network
from headway_algos.optim.adam import StackedAdam
from headway_algos.optim.fast_path import Descent, as_array, descent, perceptrons_of


def compiled_regression(
    network: Network,
    optimiser: StackedAdam,
    inputs: Tensor,
    taken: Tensor | None,
    targets: Tensor,
    value_clip: float | None,
) -> Descent | None:
    """Return the compiled steps down `squared_error`, or None if torch is to be used.

    Arguments are inputs (P, B, D), the index (P, B) of the trained output (None with one output) and targets
    (P, B). The steps report the loss.
    """
    networks = perceptrons_of(network, optimiser)
    if networks is None:
        return None
    from headway_algos import kernels

    numbers = np.empty(0, np.float32)
    bound = float("inf") if value_clip is None else float(value_clip)
    data = kernels.Targets(
        as_array(inputs, numbers), as_array(taken, np.empty(0, np.int64)), as_array(targets, numbers), bound
    )
    return descent(kernels.descend_returns, networks, optimiser, (data,), 1)
