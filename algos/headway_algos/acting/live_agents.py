"""Outputs of stacked perceptrons for the live agents of a block."""

from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from headway_algos.grouping import Grouping
from headway_algos.kernels import acting as kernel
from headway_algos.kernels.perceptron import ACTIVATIONS
from headway_algos.kernels.products import LANES


def evaluate_live(
    inputs: NDArray[Any],
    alive: NDArray[np.bool_],
    grouping: Grouping,
    layers: Sequence[tuple[NDArray[Any], NDArray[Any]]],
    activation: Literal["tanh", "relu"] = "tanh",
    normaliser: tuple[NDArray[Any], NDArray[Any], float] | None = None,
) -> NDArray[Any]:
    """Return the outputs (C, N, A) of stacked perceptrons for inputs (C, N, D).

    Outputs are 0 for agents not `alive` (C, N). `layers` are weights (P, outs, ins) and biases (P, outs, 1);
    all but the last are followed by `activation`. `normaliser`: mean and scale (P, 1, D) of the inputs, and
    the bound to which normalised inputs are clipped. A result has the same bits whatever the other agents,
    copies and replicas are.
    """
    copies, agents, size = inputs.shape
    weights, biases = zip(*layers, strict=True)
    policies, dtype = len(weights[0]), weights[0].dtype
    if normaliser is None:
        nothing = np.zeros((policies, 1, size), dtype)
        normaliser = nothing, nothing, 0.0
    most = grouping.width * (copies * grouping.num_policies // policies)
    width = max(size, *(weight.shape[1] for weight in weights))
    rows = np.empty((2, width, -(-most // LANES) * LANES), dtype)
    outputs = np.zeros((copies * agents, weights[-1].shape[1]), dtype)
    kernel.evaluate_live(
        np.ascontiguousarray(inputs).reshape(copies * agents, size), np.ascontiguousarray(alive),
        grouping.members, *normaliser, weights, biases, ACTIVATIONS[activation],
        np.empty(most, np.int64), rows, outputs,
    )  # fmt: skip
    return outputs.reshape(copies, agents, -1)
