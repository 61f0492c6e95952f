"""Inference of stacked perceptrons for acting: outputs for live agents, and sampled actions."""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from headway_algos.kernels.compiled import Floats, compiled  # isort: skip - sets numba up
from numba import types
from numba.extending import overload

from headway_algos.kernels.perceptron import LINEAR, RELU, TANH, activate, padded
from headway_algos.kernels.products import LANES, multiply

_HALF_LOG_2_PI = 0.5 * math.log(2 * math.pi)


@compiled
def _gather(
    observations: NDArray[np.float32],
    alive: NDArray[np.bool_],
    members: NDArray[np.int64],
    copies: tuple[int, int],
    mean: Floats,
    scale: Floats,
    clip: float,
    slots: NDArray[np.int64],
    rows: Floats,
) -> int:
    """Write the observations of a policy's live agents to `rows` (D, L), features first; return their number.

    Row b is that of slot `slots[b]`, copy x N + agent, ordered by agent, then copy, of the policy's `members`
    (G,) in copies from the first to before the second of `copies`. See `evaluate_live` for the rest.
    """
    n, bound = 0, mean.dtype.type(clip)
    for g in range(len(members)):
        if members[g] < 0:
            continue
        for copy in range(copies[0], copies[1]):
            if alive[copy, members[g]]:
                slots[n] = copy * alive.shape[1] + members[g]
                n += 1
    for b in range(n):
        observation = observations[slots[b]]
        for d in range(len(observation)):
            rows[d, b] = observation[d]
    for d in range(observations.shape[1]):
        row, centre, factor = rows[d], mean[d], scale[d]
        if bound > 0:
            for b in range(n):
                x = (row[b] - centre) * factor
                # Written so that NaN stays NaN.
                x = bound if x > bound else x
                row[b] = -bound if x < -bound else x
        for b in range(n, padded(n)):
            row[b] = 0
    return n


@compiled
def _layer(weight: Floats, bias: Floats, x: Floats, n: int, activation: int, y: Floats) -> None:
    """Write f(W x + b) of n columns to y (outs, .), given x (ins, .), W (outs, ins), b (outs, 1), float32."""
    outs, ins = weight.shape
    multiply(weight, 0, ins, 1, outs, ins, x, y, padded(n))
    activate(y[:outs], bias[:, 0], activation, padded(n))


@compiled
def _layer_in_float64(weight: Floats, bias: Floats, x: Floats, n: int, activation: int, y: Floats) -> None:
    """Like `_layer`, in float64."""
    outs, ins = weight.shape
    for t in range(n):
        for o in range(outs):
            total = bias[o, 0]
            for i in range(ins):
                total += weight[o, i] * x[i, t]
            if activation == TANH:
                total = math.tanh(total)
            elif activation == RELU:
                total = 0 if total < 0 else total
            y[o, t] = total


def _layer_of_dtype(weight: Floats, bias: Floats, x: Floats, n: int, activation: int, y: Floats) -> None:
    """Call `_layer` or `_layer_in_float64`, depending on the dtype.

    Exists in compiled code only, where `_choose_layer` replaces it.
    """
    raise TypeError("_layer_of_dtype can be called by compiled code only")


def _choose_layer(weight: Any, bias: Any, x: Any, n: Any, activation: Any, y: Any) -> Any:  # noqa: ANN401 - types of numba
    chosen = _layer if weight.dtype == types.float32 else _layer_in_float64

    def apply(weight: Floats, bias: Floats, x: Floats, n: int, activation: int, y: Floats) -> None:
        chosen(weight, bias, x, n, activation, y)

    return apply


overload(_layer_of_dtype, strict=False)(_choose_layer)


@compiled
def evaluate_live(
    observations: NDArray[Any],
    alive: NDArray[np.bool_],
    members: NDArray[np.int64],
    mean: Floats,
    scale: Floats,
    clip: float,
    weights: tuple[Floats, ...],
    biases: tuple[Floats, ...],
    activation: int,
    slots: NDArray[np.int64],
    rows: Floats,
    outputs: Floats,
) -> None:
    """Write the outputs of stacked perceptrons to `outputs` (C N, A), for the live slots of `alive` (C, N).

    `observations` are (C N, D). `members` (K, G) are the agents of each policy of a replica, padded with -1.
    Observations are normalised with `mean` and `scale` (P, 1, D) and clipped at +-`clip`; unchanged if `clip`
    is 0. `weights` are (P, outs, ins) and `biases` (P, outs, 1) per layer; `activation` is that of all layers
    but the last, which is linear. `slots` (B,) and `rows` (2, W, L) are overwritten.

    Each row is computed on its own, so that its result does not depend on the others, to the last bit.
    """
    policies = len(members)
    each = len(alive) * policies // len(mean)
    for p in range(len(mean)):
        first = p // policies * each
        copies = (first, first + each)
        agents = members[p % policies]
        n = _gather(observations, alive, agents, copies, mean[p, 0], scale[p, 0], clip, slots, rows[0])
        if n == 0:
            continue
        for k in range(len(weights)):
            f = activation if k < len(weights) - 1 else LINEAR
            _layer_of_dtype(weights[k][p], biases[k][p], rows[k % 2], n, f, rows[(k + 1) % 2])
        last = rows[len(weights) % 2]
        for b in range(n):
            for a in range(outputs.shape[1]):
                outputs[slots[b], a] = last[a, b]


@compiled
def choose_categorical(
    logits: Floats,
    options: NDArray[np.int64],
    alive: NDArray[np.bool_],
    masks: NDArray[np.bool_],
    uniforms: NDArray[np.float64],
    weights: NDArray[np.float64],
    actions: NDArray[np.int64],
    log_probs: NDArray[np.float64],
) -> None:
    """Sample `actions` (B, K) of K independent choices by inverting their distribution functions, and write
    the `log_probs` (B,) of all together; 0 for slots not `alive` (B,).

    `logits` are (B, A), one per option: `options` (K,) per choice, one choice after the other. `masks` (B, A)
    are the allowed options, empty if all are allowed; `uniforms` (B, K) are draws from [0, 1), empty for the
    most probable options. Forbidden options have probability exactly 0. `weights` (A,) is overwritten.
    """
    masked, greedy = len(masks) > 0, len(uniforms) == 0
    for b in range(len(logits)):
        log_probs[b], first = 0.0, 0
        for k in range(len(options)):
            actions[b, k] = 0
            last = first + options[k]
            if not alive[b]:
                continue
            # Relative to the largest logit, so that exp cannot overflow.
            most, best = -math.inf, first
            for a in range(first, last):
                if (not masked or masks[b, a]) and logits[b, a] > most:
                    most, best = logits[b, a], a
            total = 0.0
            for a in range(first, last):
                if not masked or masks[b, a]:
                    weights[a] = math.exp(logits[b, a] - most)
                    total += weights[a]
            chosen = best
            if not greedy:
                # Rounding may leave the sum of all weights below the draw: the last allowed option is chosen.
                below, bound = 0.0, uniforms[b, k] * total
                for a in range(first, last):
                    if not masked or masks[b, a]:
                        below += weights[a]
                        chosen = a
                        if below > bound:
                            break
            actions[b, k] = chosen - first
            log_probs[b] += logits[b, chosen] - most - math.log(total)
            first = last


@compiled
def choose_gaussian(
    means: Floats,
    alive: NDArray[np.bool_],
    policies: NDArray[np.int64],
    log_std: Floats,
    normals: NDArray[np.float64],
    actions: NDArray[np.float32],
    log_probs: NDArray[np.float64],
) -> None:
    """Sample an action (A,) per live slot; 0 for slots not `alive` (B,).

    `means` are (B, A), `log_std` (P, A, 1), that of slot b in row `policies[b]`. `normals` are (B, A), empty
    for the mean. Actions are not clipped.
    """
    greedy = len(normals) == 0
    for b in range(len(means)):
        total = 0.0
        for a in range(means.shape[1]):
            actions[b, a] = 0
            if not alive[b]:
                continue
            spread = log_std[policies[b], a, 0]
            deviation = math.exp(spread)
            actions[b, a] = means[b, a] + (0.0 if greedy else deviation * normals[b, a])
            # The density is that of the action as stored in float32, which is what the learner sees.
            standard = (actions[b, a] - means[b, a]) / deviation
            total -= 0.5 * standard * standard + spread + _HALF_LOG_2_PI
        log_probs[b] = total


def warm_acting() -> None:
    """Compile the kernels of this file, or load them from the cache.

    Networks of up to two hidden layers in float32 and of two in float64; others are compiled when first used.
    """
    indices, draws, log_probs = np.zeros((1, 1), np.int64), np.zeros((1, 1)), np.zeros(1)
    alive = masks = np.zeros((1, 1), np.bool_)
    for dtype, depths in ((np.float32, (1, 2, 3)), (np.float64, (3,))):
        rows, one, table = np.zeros((2, 1, LANES), dtype), np.zeros((1, 1, 1), dtype), np.zeros((1, 1), dtype)
        inputs = {np.dtype(np.float32), np.dtype(dtype)}
        for depth in depths:
            layers = (one,) * depth
            for kind in inputs:
                observations = np.zeros((1, 1), kind)
                evaluate_live(
                    observations, alive, indices, one, one, 0.0, layers, layers, TANH, indices[0], rows, table
                )
        choose_categorical(table, indices[0], alive[0], masks, draws, draws[0], indices, log_probs)
        choose_gaussian(table, alive[0], indices[0], one, draws, np.zeros((1, 1), np.float32), log_probs)
