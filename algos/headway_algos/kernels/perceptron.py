"""Forward and backward passes of multilayer perceptrons in float32, features first."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from headway_algos.kernels.compiled import ONE, ZERO, Floats, compiled
from headway_algos.kernels.products import LANES, add_outer, multiply

ROWS = 5 * 48
"""Maximum number of rows passed through a network at a time, so that they stay in the cache; a multiple of
`TILE` for any number of lanes, because parts are made of whole tiles."""
SCRATCH = 5
"""Intermediate results per row that the losses keep."""


LINEAR, TANH, RELU = 0, 1, 2
ACTIVATIONS = {"tanh": TANH, "relu": RELU}


class Perceptrons(NamedTuple):
    """P stacked perceptrons, with memory for the passes of one of them."""

    values: Floats
    """(P, V): all parameters."""
    gradient: Floats
    """(P, V): their gradients."""
    layers: NDArray[np.int64]
    """(L, 4): per layer, number of inputs, number of outputs, offsets of weights and of biases."""
    activation: int
    """Activation of the hidden layers: one of `ACTIVATIONS`."""
    activations: Floats
    """(F, ROWS): the inputs of each layer, then the outputs."""
    errors: Floats
    """(2, W, ROWS): d loss / d activations of two layers that follow each other."""
    scratch: Floats
    """(SCRATCH, ROWS)"""
    exponents: NDArray[np.int32]
    """(ROWS,): scratch for `exp`, the exponent bits of floating-point numbers."""
    powers: Floats
    """(ROWS,): view of `exponents` as float32, a power of two each."""

    @property
    def outputs(self) -> int:
        """Return the number of outputs."""
        return int(self.layers[-1, 1])


def perceptrons(values: Floats, gradient: Floats, layers: NDArray[np.int64], activation: int) -> Perceptrons:
    """Return perceptrons with the memory that they need."""
    activations = np.empty((layers[0, 0] + layers[:, 1].sum(), ROWS), np.float32)
    errors = np.empty((2, layers[:, 1].max(), ROWS), np.float32)
    exponents = np.empty(ROWS, np.int32)
    scratch = np.empty((SCRATCH, ROWS), np.float32)
    powers = exponents.view(np.float32)
    return Perceptrons(values, gradient, layers, activation, activations, errors, scratch, exponents, powers)


# tanh(x) / x = P(x^2) / Q(x^2), a minimax fit of relative error 2.5e-7 up to where tanh is 1 in float32 (with
# rounding 4.7e-7). Both are divided by Q's last coefficient, which saves a multiplication.
_END = np.float32(8.5)
_P = tuple(np.float32(c) for c in (4351851.29, 560566.104, 12634.8803, 47.5177533))
_Q = tuple(np.float32(c) for c in (4351852.34, 2011175.38, 102790.406, 1009.45499))


@compiled
def tanh(row: Floats, bias: np.float32, n: int) -> None:
    """Replace x by tanh(x + bias)."""
    for t in range(n):
        x = row[t] + bias
        # Written so that NaN stays NaN.
        a = abs(x)
        a = _END if a > _END else a
        s = a * a
        p = ((_P[3] * s + _P[2]) * s + _P[1]) * s + _P[0]
        q = (((s + _Q[3]) * s + _Q[2]) * s + _Q[1]) * s + _Q[0]
        y = a * p / q
        row[t] = math.copysign(ONE if y > ONE else y, x)


@compiled
def activate(y: Floats, biases: Floats, activation: int, n: int) -> None:
    """Replace the first n columns of y (O, .) by f(y + biases); `biases` are (O,), `activation` selects f."""
    for o in range(len(y)):
        y0, bias = y[o], biases[o]
        if activation == TANH:
            tanh(y0, bias, n)
        elif activation == RELU:
            for t in range(n):
                y0[t] = ZERO if y0[t] + bias < ZERO else y0[t] + bias
        else:
            for t in range(n):
                y0[t] += bias


@compiled
def padded(n: int) -> int:
    """Return n rounded up to a multiple of LANES."""
    return (n + LANES - 1) // LANES * LANES


@compiled
def numbers(layer: NDArray[np.int64]) -> tuple[int, int, int, int]:
    """Return a layer's number of inputs, of outputs, and its offsets of weights and of biases."""
    return layer[0], layer[1], layer[2], layer[3]


@compiled
def forward(net: Perceptrons, p: int, rows: Floats, index: NDArray[np.int64]) -> None:
    """Evaluate network p on the rows `index` (n,) of `rows` (., D), padded with 0 to a multiple of LANES."""
    values, n, top = net.values[p], padded(len(index)), 0
    for t in range(len(index)):
        row = rows[index[t]]
        for i in range(net.layers[0, 0]):
            net.activations[i, t] = row[i]
    # Whole vectors of rows are computed: padding must be finite.
    for i in range(net.layers[0, 0]):
        for t in range(len(index), n):
            net.activations[i, t] = ZERO
    for layer in range(len(net.layers)):
        ins, outs, weights, biases = numbers(net.layers[layer])
        x = net.activations[top : top + ins]
        top += ins
        y = net.activations[top : top + outs]
        multiply(values, weights, ins, 1, outs, ins, x, y, n)
        activate(y, values[biases:], net.activation if layer < len(net.layers) - 1 else LINEAR, n)


@compiled
def backward(net: Perceptrons, p: int, n: int) -> None:
    """Add a loss's gradient to `net.gradient`, for the n rows of the last `forward` pass, through network p.

    On entry `net.errors[L % 2]` holds d loss / d outputs, for L layers.
    """
    values, gradient, layers = net.values[p], net.gradient[p], net.layers
    # Padding must not contribute to the sums over rows.
    for a in range(layers[-1, 1]):
        for t in range(n, padded(n)):
            net.errors[len(layers) % 2, a, t] = ZERO
    n, top = padded(n), layers[:, 0].sum()
    for layer in range(len(layers) - 1, -1, -1):
        ins, outs, weights, biases = numbers(layers[layer])
        top -= ins
        x, error = net.activations[top : top + ins], net.errors[(layer + 1) % 2]
        add_outer(x, error, ins, outs, gradient, weights, n)
        for o in range(outs):
            e0, total = error[o], ZERO
            for t in range(n):
                total += e0[t]
            gradient[biases + o] += total
        # The inputs are data, which need no gradient.
        if layer == 0:
            break
        before = net.errors[layer % 2]
        multiply(values, weights, 1, ins, ins, outs, error, before, n)
        for i in range(ins):
            # Either derivative follows from the activated value, so pre-activations need not be stored.
            g0, x0 = before[i], x[i]
            if net.activation == RELU:
                for t in range(n):
                    g0[t] = g0[t] if x0[t] > ZERO else ZERO
            else:
                for t in range(n):
                    g0[t] *= ONE - x0[t] * x0[t]


@compiled
def layer(
    weight: Floats, bias: Floats, inputs: Floats, counts: NDArray[np.int64], activation: int, outputs: Floats
) -> None:
    """Write activation(W x + b) of P networks to `outputs` (P, outs, L), given `inputs` (P, ins, L), float32.

    `weight` is (P, outs x ins), `bias` (P, outs). The first `counts` (P,) lanes are rows; those after the
    next multiple of LANES become 0.
    """
    outs, ins = outputs.shape[1], inputs.shape[1]
    for p in range(len(weight)):
        n = padded(counts[p])
        multiply(weight[p], 0, ins, 1, outs, ins, inputs[p], outputs[p], n)
        activate(outputs[p], bias[p], activation, n)
        for o in range(outs):
            outputs[p, o, n:] = ZERO


@compiled
def activate_stack(y: Floats, biases: Floats, activation: int) -> None:
    """Replace y (P, O, B) by f(y + b), with `biases` (P, O) and f by `activation`."""
    for p in range(len(y)):
        activate(y[p], biases[p], activation, y.shape[2])


def evaluate(layers: Sequence[tuple[Floats, Floats]], rows: Floats, activation: str) -> Floats:
    """Return the outputs (P, O, B) of stacked networks for rows (P, B, D).

    `layers` are weights (P, out, in) and biases (P, out, 1). A row's result does not depend on the others.
    """
    stack, batch, size = rows.shape
    # Contiguous, because numba would compile `layer` a second time for views of all parameters.
    flat = [
        (np.ascontiguousarray(weight.reshape(stack, -1)), np.ascontiguousarray(bias.reshape(stack, -1)))
        for weight, bias in layers
    ]
    outputs = np.empty((stack, layers[-1][0].shape[1], batch), np.float32)
    for start in range(0, batch, ROWS):
        part = rows[:, start : start + ROWS]
        x = np.zeros((stack, size, padded(part.shape[1])), np.float32)
        x[:, :, : part.shape[1]] = part.swapaxes(1, 2)
        counts = np.full(stack, part.shape[1])
        for i, (weight, bias) in enumerate(flat):
            y = np.empty((stack, bias.shape[1], x.shape[2]), np.float32)
            layer(weight, bias, x, counts, ACTIVATIONS[activation] if i < len(layers) - 1 else LINEAR, y)
            x = y
        outputs[:, :, start : start + ROWS] = x[:, :, : part.shape[1]]
    return outputs
