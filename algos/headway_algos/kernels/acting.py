"""Inference of stacked perceptrons for acting: rows of live agents, layers, and sampled actions."""

import math

import numpy as np
from numpy.typing import NDArray

from headway_algos.kernels.compiled import Floats, compiled
from headway_algos.kernels.perceptron import RELU, TANH, layer, padded
from headway_algos.kernels.products import LANES

_HALF_LOG_2_PI = 0.5 * math.log(2 * math.pi)


@compiled
def gather(
    observations: NDArray[np.float32],
    alive: NDArray[np.bool_],
    members: NDArray[np.int64],
    mean: Floats,
    scale: Floats,
    clip: float,
    slots: NDArray[np.int64],
    counts: NDArray[np.int64],
    rows: Floats,
) -> None:
    """Write the observations (C N, D) of live slots (C, N) by policy to `rows` (P, D, L), features first.

    `members` (K, G) are the agents of each policy of a replica, padded with -1. Row b of policy p belongs to
    slot `slots[p, b]`, copy x N + agent, ordered by agent, then copy; `counts` (P,) are the numbers of rows.
    Lanes up to the next multiple of LANES are 0. Observations are normalised with `mean` and `scale`
    (P, 1, D) and clipped at +-`clip`; unchanged if `clip` is 0.
    """
    copies, agents = alive.shape
    policies, size = len(members), observations.shape[1]
    each, bound = copies * policies // len(rows), mean.dtype.type(clip)
    for p in range(len(rows)):
        first = p // policies * each
        n = 0
        for g in range(members.shape[1]):
            agent = members[p % policies, g]
            if agent < 0:
                continue
            for copy in range(first, first + each):
                if alive[copy, agent]:
                    slots[p, n] = copy * agents + agent
                    n += 1
        counts[p] = n
        for b in range(n):
            observation = observations[slots[p, b]]
            for d in range(size):
                rows[p, d, b] = observation[d]
        for d in range(size):
            row, centre, factor = rows[p, d], mean[p, 0, d], scale[p, 0, d]
            if bound > 0:
                for b in range(n):
                    x = (row[b] - centre) * factor
                    # Written so that NaN stays NaN.
                    x = bound if x > bound else x
                    row[b] = -bound if x < -bound else x
            for b in range(n, padded(n)):
                row[b] = 0


@compiled
def layer_in_float64(
    weight: Floats, bias: Floats, inputs: Floats, counts: NDArray[np.int64], activation: int, outputs: Floats
) -> None:
    """Do what `layer` does in float32, row by row; lanes that are not rows become 0."""
    outs, ins = outputs.shape[1], inputs.shape[1]
    for p in range(len(weight)):
        for t in range(counts[p]):
            for o in range(outs):
                total = bias[p, o]
                for i in range(ins):
                    total += weight[p, o * ins + i] * inputs[p, i, t]
                if activation == TANH:
                    total = math.tanh(total)
                elif activation == RELU:
                    total = 0 if total < 0 else total
                outputs[p, o, t] = total
        for o in range(outs):
            outputs[p, o, counts[p] :] = 0


@compiled
def scatter(rows: Floats, slots: NDArray[np.int64], counts: NDArray[np.int64], by_slot: Floats) -> None:
    """Write `rows` (P, A, L) to the slots (C N, A) that they belong to, as `gather` found them."""
    for p in range(len(rows)):
        for b in range(counts[p]):
            for a in range(rows.shape[1]):
                by_slot[slots[p, b], a] = rows[p, a, b]


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
                # Rounding may leave the sum of all probabilities below the draw: the last allowed one then.
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
    log_std: Floats,
    normals: NDArray[np.float64],
    actions: NDArray[np.float32],
    log_probs: NDArray[np.float64],
) -> None:
    """Sample an action (A,) per live slot; 0 for slots not `alive` (B,).

    `means` and `log_std` are (B, A), `normals` (B, A), empty for the mean. Actions are not clipped.
    """
    greedy = len(normals) == 0
    for b in range(len(means)):
        total = 0.0
        for a in range(means.shape[1]):
            actions[b, a] = 0
            if not alive[b]:
                continue
            deviation = math.exp(log_std[b, a])
            actions[b, a] = means[b, a] + (0.0 if greedy else deviation * normals[b, a])
            # Of the action as stored in float32, which is what the learner sees.
            standard = (actions[b, a] - means[b, a]) / deviation
            total -= 0.5 * standard * standard + log_std[b, a] + _HALF_LOG_2_PI
        log_probs[b] = total


def warm_acting() -> None:
    """Compile the kernels of this file for both dtypes, or load them from the cache."""
    counts, slots, indices = np.zeros(1, np.int64), np.zeros((1, 1), np.int64), np.zeros((1, 1), np.int64)
    alive, masks, draws = np.zeros((1, 1), np.bool_), np.zeros((1, 1), np.bool_), np.zeros((1, 1))
    observations, log_probs = np.zeros((1, 1), np.float32), np.zeros(1)
    for dtype, apply in ((np.float32, layer), (np.float64, layer_in_float64)):
        cube, one, table = np.zeros((1, 1, LANES), dtype), np.zeros((1, 1, 1), dtype), np.zeros((1, 1), dtype)
        gather(observations, alive, indices, one, one, 0.0, slots, counts, cube)
        apply(table, table, cube, counts, TANH, cube)
        scatter(cube, slots, counts, table)
        choose_categorical(table, counts, alive[0], masks, draws, draws[0], indices, log_probs)
        choose_gaussian(table, alive[0], table, draws, np.zeros((1, 1), np.float32), log_probs)
