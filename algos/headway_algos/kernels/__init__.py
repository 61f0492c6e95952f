"""Compiled training steps on a CPU, and the forward pass that workers act with; without torch.

For small matrices torch's call overhead exceeds the arithmetic, and on some processors its matrix products
are slower than these kernels' at any size.
"""

import math

import numpy as np

from headway_algos.kernels.acting import warm_acting
from headway_algos.kernels.adam import Adam, step_networks
from headway_algos.kernels.gae import write_advantages
from headway_algos.kernels.jacobian import add_transposed_jacobian, multiply_jacobian, store_activations
from headway_algos.kernels.minibatch_steps import (
    BoxActions,
    DiscreteActions,
    PolicyData,
    RowIndices,
    Targets,
    descend_categorical,
    descend_gaussian,
    descend_returns,
)
from headway_algos.kernels.moments import write_moments
from headway_algos.kernels.perceptron import (
    ROWS,
    TANH,
    activate_stack,
    evaluate,
    perceptrons,
)


def warm() -> None:
    """Compile all kernels, or load them from the cache, by calling them with empty minibatches."""
    counts, active = np.zeros(1, np.int64), np.ones(1, np.bool_)
    for dtype in (np.float32, np.float64):
        of, norms = np.zeros((1, 1), dtype), np.zeros(1, dtype)
        write_moments(of[None], np.zeros((1, 1), np.bool_), np.zeros((1, 1)), np.zeros((1, 1)))
        adam = Adam(of, of, counts, 0.0, math.inf, (0.0, 0.0), 1.0)
        step_networks(of, of, adam, active, norms)
    table, row = np.zeros((1, 1), np.float32), np.zeros(1, np.float32)
    steps = (
        perceptrons(table, table, np.array([[1, 1, 0, 0]]), TANH),
        Adam(table, table, counts, 0.0, math.inf, (0.0, 0.0), 1.0),
        RowIndices(np.zeros((0, 1, 0), np.int64), np.zeros((0, 1), np.int64)),
    )
    policy = PolicyData(table, row, row, table, row, True, 0.0, 0.0)
    descend_gaussian(*steps, policy, BoxActions(table, table, 0), table, row)
    descend_categorical(*steps, policy, DiscreteActions(counts, np.ones((1, 1), np.bool_)), table, row)
    descend_returns(*steps, Targets(table, counts, row, 0.0), table, row)
    stored, none = np.zeros((1, 1, 2, ROWS), np.float32), np.zeros(1, np.int64)
    store_activations(steps[0], table, np.zeros((1, 1), np.int64), none, stored)
    multiply_jacobian(steps[0], table, stored, none, table[None])
    add_transposed_jacobian(steps[0], table[None], stored, none)
    evaluate([(table[None], table[None])], table[None], "tanh")
    activate_stack(table[None], table, TANH)
    warm_acting()
    numbers, states = np.zeros((1, 1)), np.zeros((1, 1), np.bool_)
    write_advantages(numbers[:0], numbers, numbers, states, states, states, 0.0, 0.0, numbers)
