"""Products with the Jacobian J of stacked perceptrons' outputs in their parameters, at fixed parameters.

J v is computed by forward differentiation, layer by layer (Pearlmutter 1994, "Fast Exact Multiplication by
the Hessian"), J^T u by backpropagation. Both reuse stored activations. Each network works on its own rows, in
blocks that fit the cache, so that its result does not depend on its stack.
"""

import numpy as np
from numpy.typing import NDArray

from headway_algos.kernels.compiled import ONE, ZERO, Floats, compiled
from headway_algos.kernels.perceptron import RELU, ROWS, Perceptrons, backward, forward, numbers, padded
from headway_algos.kernels.products import multiply


@compiled
def store_activations(
    net: Perceptrons, rows: Floats, index: NDArray[np.int64], counts: NDArray[np.int64], stored: Floats
) -> None:
    """Evaluate network p on its first `counts[p]` rows `index` (P, W) of `rows` (P W, D).

    `stored` (P, K, F, ROWS) are the activations of each block of ROWS rows, as in `Perceptrons.activations`.
    """
    for p in range(len(index)):
        for start in range(0, counts[p], ROWS):
            n = min(ROWS, counts[p] - start)
            forward(net, p, rows, index[p, start : start + n])
            block = stored[p, start // ROWS]
            for f in range(len(block)):
                for t in range(padded(n)):
                    block[f, t] = net.activations[f, t]


@compiled
def multiply_jacobian(
    net: Perceptrons, direction: Floats, stored: Floats, counts: NDArray[np.int64], products: Floats
) -> None:
    """Write J v to `products` (P, A, W), for `direction` v (P, V)."""
    layers, added = net.layers, net.activations
    for p in range(len(stored)):
        for start in range(0, counts[p], ROWS):
            rows, top = min(ROWS, counts[p] - start), 0
            block, n = stored[p, start // ROWS], padded(rows)
            for layer in range(len(layers)):
                ins, outs, weights, biases = numbers(layers[layer])
                # The layer's outputs change by dW x + W dx + db: `change` becomes dW x, `added` W dx. The
                # inputs of the first layer are fixed.
                change, before = net.errors[layer % 2], net.errors[(layer + 1) % 2]
                multiply(direction[p], weights, ins, 1, outs, ins, block[top : top + ins], change, n)
                if layer > 0:
                    multiply(net.values[p], weights, ins, 1, outs, ins, before, added, n)
                top += ins
                for o in range(outs):
                    changed, activated, bias = change[o], block[top + o], direction[p, biases + o]
                    if layer > 0:
                        for t in range(n):
                            changed[t] += added[o, t]
                    if layer == len(layers) - 1:
                        for t in range(rows):
                            products[p, o, start + t] = changed[t] + bias
                    elif net.activation == RELU:
                        for t in range(n):
                            changed[t] = changed[t] + bias if activated[t] > ZERO else ZERO
                    else:
                        for t in range(n):
                            changed[t] = (changed[t] + bias) * (ONE - activated[t] * activated[t])


@compiled
def add_transposed_jacobian(
    net: Perceptrons, signals: Floats, stored: Floats, counts: NDArray[np.int64]
) -> None:
    """Add J^T u, summed over the rows, to `net.gradient`, for `signals` u (P, A, W)."""
    last = net.errors[len(net.layers) % 2]
    for p in range(len(stored)):
        for start in range(0, counts[p], ROWS):
            n, block = min(ROWS, counts[p] - start), stored[p, start // ROWS]
            for f in range(len(block)):
                for t in range(padded(n)):
                    net.activations[f, t] = block[f, t]
            for a in range(signals.shape[1]):
                for t in range(n):
                    last[a, t] = signals[p, a, start + t]
            backward(net, p, n)
