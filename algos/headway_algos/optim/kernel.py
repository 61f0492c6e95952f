"""Compiled training steps on a CPU: forward and backward passes of small perceptrons, losses, Adam.

For small matrices torch's call overhead exceeds the arithmetic, and on some processors its matrix products
are slower than these at any size. The networks of a stack are processed one after another, each on its own
rows in parts that fit the cache, features first, so that a network's result does not depend on its stack. The
equations stand at the torch equivalents, against which the kernels are tested: `updates.ppo`, `updates.a2c`,
`critics.return_regression`. One file holds them all, because numba watches only the file of the function that
is called for changes.
"""

import math
from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar

import numpy as np
from numpy.typing import NDArray

from headway.contracts.numba_setup import compiled_with

P = ParamSpec("P")
R = TypeVar("R")
Floats = NDArray[Any]
"""Floating-point array in the networks' dtype."""

ROWS, LANES = 256, 32
"""Maximum number of rows passed through a network at a time, and the multiple to which it is padded: loops
over whole vectors run up to a third faster than loops with a remainder."""
SCRATCH = 5
"""Intermediate results per row that the losses keep."""
_ZERO, _ONE = np.float32(0), np.float32(1)


def _compiled(function: Callable[P, R]) -> Callable[P, R]:
    """Compile without memory allocation; sums may be reordered and fused, NaN and infinities are kept."""
    return compiled_with(function, _nrt=False, fastmath={"contract", "reassoc", "nsz"})


# tanh(x) / x = P(x^2) / Q(x^2), a minimax fit of relative error 1.2e-8 up to where tanh is 1 in float32.
_END = np.float32(8.5)
_P = tuple(
    np.float32(c)
    for c in (1, 0.13413232564926147, 3.5340096801519394e-3, 2.1250756617519073e-5, 1.4268818127050054e-8)
)
_Q = tuple(
    np.float32(c)
    for c in (1, 0.4674655497074127, 2.6022685691714287e-2, 3.348836617078632e-4, 8.144958201228292e-7)
)


@_compiled
def _tanh(row: Floats, n: int) -> None:
    for t in range(n):
        x = row[t]
        # Written so that NaN stays NaN.
        x = _END if x > _END else x
        x = -_END if x < -_END else x
        s = x * x
        p = (((_P[4] * s + _P[3]) * s + _P[2]) * s + _P[1]) * s + _P[0]
        q = (((_Q[4] * s + _Q[3]) * s + _Q[2]) * s + _Q[1]) * s + _Q[0]
        y = x * p / q
        y = _ONE if y > _ONE else y
        row[t] = -_ONE if y < -_ONE else y


# exp(x) = 2^k exp(r), |r| <= log(2) / 2, and exp(r) = 1 + r + r^2 E(r): the coefficients of Cephes' expf.
_E = tuple(
    np.float32(c)
    for c in (
        5.0000001201e-1,
        1.6666665459e-1,
        4.1665795894e-2,
        8.3334519073e-3,
        1.3981999507e-3,
        1.9875691500e-4,
    )
)
_LOG2_E, _LN2_HIGH, _LN2_LOW = np.float32(1.44269504), np.float32(0.693359375), np.float32(-2.12194440e-4)
_LEAST, _MOST, _HALF = np.float32(-87), np.float32(88), np.float32(0.5)


def _exp_by_parts(row: Floats, bits: NDArray[np.int32], powers: Floats, n: int) -> None:
    """Replace x by exp(x), 0 below -87 and exp(88) above; `powers` (ROWS,) are the same memory as `bits`."""
    for t in range(n):
        x = row[t]
        below = x < _LEAST
        x = _MOST if x > _MOST else x
        k = np.floor(x * _LOG2_E + _HALF)
        r = x - k * _LN2_HIGH
        r = r - k * _LN2_LOW
        e = ((((_E[5] * r + _E[4]) * r + _E[3]) * r + _E[2]) * r + _E[1]) * r + _E[0]
        row[t] = e * r * r + r + _ONE
        bits[t] = 0 if below else (np.int32(k) + 127) << 23
    for t in range(n):
        row[t] = _ZERO if bits[t] == 0 else row[t] * powers[t]


# Sums keep their order here: with another, what is left after log(2) k would lose its digits.
_exp = compiled_with(_exp_by_parts, _nrt=False, fastmath={"contract"})


@_compiled
def _add_product(
    w: Floats, step_out: int, step_in: int, outs: int, ins: int, x: Floats, y: Floats, n: int
) -> None:
    """y[o] += sum_i w[o step_out + i step_in] x[i], in n columns; in blocks of 4 x 4, which reuse loads."""
    whole_outs, whole_ins = outs - outs % 4, ins - ins % 4
    for o in range(0, whole_outs, 4):
        y0, y1, y2, y3 = y[o], y[o + 1], y[o + 2], y[o + 3]
        a = o * step_out
        b, c, d = a + step_out, a + 2 * step_out, a + 3 * step_out
        for i in range(0, whole_ins, 4):
            x0, x1, x2, x3 = x[i], x[i + 1], x[i + 2], x[i + 3]
            i0 = i * step_in
            i1, i2, i3 = i0 + step_in, i0 + 2 * step_in, i0 + 3 * step_in
            a0, a1, a2, a3 = w[a + i0], w[a + i1], w[a + i2], w[a + i3]
            b0, b1, b2, b3 = w[b + i0], w[b + i1], w[b + i2], w[b + i3]
            c0, c1, c2, c3 = w[c + i0], w[c + i1], w[c + i2], w[c + i3]
            d0, d1, d2, d3 = w[d + i0], w[d + i1], w[d + i2], w[d + i3]
            for t in range(n):
                u0, u1, u2, u3 = x0[t], x1[t], x2[t], x3[t]
                y0[t] += a0 * u0 + a1 * u1 + a2 * u2 + a3 * u3
                y1[t] += b0 * u0 + b1 * u1 + b2 * u2 + b3 * u3
                y2[t] += c0 * u0 + c1 * u1 + c2 * u2 + c3 * u3
                y3[t] += d0 * u0 + d1 * u1 + d2 * u2 + d3 * u3
        for i in range(whole_ins, ins):
            x0 = x[i]
            i0 = i * step_in
            a0, b0, c0, d0 = w[a + i0], w[b + i0], w[c + i0], w[d + i0]
            for t in range(n):
                y0[t] += a0 * x0[t]
                y1[t] += b0 * x0[t]
                y2[t] += c0 * x0[t]
                y3[t] += d0 * x0[t]
    for o in range(whole_outs, outs):
        y0 = y[o]
        for i in range(ins):
            x0, a0 = x[i], w[o * step_out + i * step_in]
            for t in range(n):
                y0[t] += a0 * x0[t]


@_compiled
def _add_outer(g: Floats, x: Floats, outs: int, ins: int, w: Floats, n: int) -> None:
    """w[o, i] += sum_t g[o, t] x[i, t], with w in row-major order; in blocks of 4 x 4, which reuse loads."""
    whole_outs, whole_ins = outs - outs % 4, ins - ins % 4
    for o in range(0, whole_outs, 4):
        g0, g1, g2, g3 = g[o], g[o + 1], g[o + 2], g[o + 3]
        for i in range(0, whole_ins, 4):
            x0, x1, x2, x3 = x[i], x[i + 1], x[i + 2], x[i + 3]
            a0 = a1 = a2 = a3 = b0 = b1 = b2 = b3 = _ZERO
            c0 = c1 = c2 = c3 = d0 = d1 = d2 = d3 = _ZERO
            for t in range(n):
                u0, u1, u2, u3 = x0[t], x1[t], x2[t], x3[t]
                v0, v1, v2, v3 = g0[t], g1[t], g2[t], g3[t]
                a0 += v0 * u0
                a1 += v0 * u1
                a2 += v0 * u2
                a3 += v0 * u3
                b0 += v1 * u0
                b1 += v1 * u1
                b2 += v1 * u2
                b3 += v1 * u3
                c0 += v2 * u0
                c1 += v2 * u1
                c2 += v2 * u2
                c3 += v2 * u3
                d0 += v3 * u0
                d1 += v3 * u1
                d2 += v3 * u2
                d3 += v3 * u3
            at = o * ins + i
            w[at] += a0
            w[at + 1] += a1
            w[at + 2] += a2
            w[at + 3] += a3
            at += ins
            w[at] += b0
            w[at + 1] += b1
            w[at + 2] += b2
            w[at + 3] += b3
            at += ins
            w[at] += c0
            w[at + 1] += c1
            w[at + 2] += c2
            w[at + 3] += c3
            at += ins
            w[at] += d0
            w[at + 1] += d1
            w[at + 2] += d2
            w[at + 3] += d3
        for i in range(whole_ins, ins):
            x0 = x[i]
            a0 = b0 = c0 = d0 = _ZERO
            for t in range(n):
                a0 += g0[t] * x0[t]
                b0 += g1[t] * x0[t]
                c0 += g2[t] * x0[t]
                d0 += g3[t] * x0[t]
            at = o * ins + i
            w[at] += a0
            w[at + ins] += b0
            w[at + 2 * ins] += c0
            w[at + 3 * ins] += d0
    for o in range(whole_outs, outs):
        g0 = g[o]
        for i in range(ins):
            x0, a0 = x[i], _ZERO
            for t in range(n):
                a0 += g0[t] * x0[t]
            w[o * ins + i] += a0


@_compiled
def _padded(n: int) -> int:
    """Return n rounded up to a multiple of LANES."""
    return (n + LANES - 1) // LANES * LANES


@_compiled
def _forward(
    values: Floats, form: NDArray[np.int64], relu: bool, held: Floats, rows: Floats, index: NDArray[np.int64]
) -> None:
    """Evaluate one network, `values` (V,), on the rows `index` (n,) of `rows` (., D).

    Writes the inputs of each layer, then the outputs, to `held` (F, ROWS), padded with rows of 0 to a
    multiple of LANES. `form` (L, 4) holds each layer's number of inputs, number of outputs, and offsets of
    weights and biases.
    """
    n, top = _padded(len(index)), 0
    for t in range(len(index)):
        row = rows[index[t]]
        for i in range(form[0, 0]):
            held[i, t] = row[i]
    for i in range(form[0, 0]):
        for t in range(len(index), n):
            held[i, t] = _ZERO
    for layer in range(len(form)):
        ins, outs, weights, biases = form[layer, 0], form[layer, 1], form[layer, 2], form[layer, 3]
        x = held[top : top + ins]
        top += ins
        y = held[top : top + outs]
        for o in range(outs):
            y0, bias = y[o], values[biases + o]
            for t in range(n):
                y0[t] = bias
        _add_product(values[weights:], ins, 1, outs, ins, x, y, n)
        if layer < len(form) - 1:
            for o in range(outs):
                y0 = y[o]
                if relu:
                    for t in range(n):
                        y0[t] = _ZERO if y0[t] < _ZERO else y0[t]
                else:
                    _tanh(y0, n)


@_compiled
def _backward(
    values: Floats,
    form: NDArray[np.int64],
    relu: bool,
    held: Floats,
    signals: Floats,
    gradient: Floats,
    n: int,
) -> None:
    """Add a loss's gradient on n rows to `gradient` (V,) of one network.

    `signals` (2, W, ROWS) holds d loss / d outputs at index len(form) % 2.
    """
    last = signals[len(form) % 2]
    for a in range(form[-1, 1]):
        for t in range(n, _padded(n)):
            last[a, t] = _ZERO
    n, top = _padded(n), 0
    for layer in range(len(form)):
        top += form[layer, 0]
    for layer in range(len(form) - 1, -1, -1):
        ins, outs, weights, biases = form[layer, 0], form[layer, 1], form[layer, 2], form[layer, 3]
        top -= ins
        x, signal = held[top : top + ins], signals[(layer + 1) % 2]
        _add_outer(signal, x, outs, ins, gradient[weights:], n)
        for o in range(outs):
            g0, total = signal[o], _ZERO
            for t in range(n):
                total += g0[t]
            gradient[biases + o] += total
        if layer == 0:
            break
        before = signals[layer % 2]
        for i in range(ins):
            g0 = before[i]
            for t in range(n):
                g0[t] = _ZERO
        _add_product(values[weights:], 1, ins, ins, outs, signal, before, n)
        for i in range(ins):
            g0, x0 = before[i], x[i]
            if relu:
                for t in range(n):
                    g0[t] = g0[t] if x0[t] > _ZERO else _ZERO
            else:
                for t in range(n):
                    g0[t] *= _ONE - x0[t] * x0[t]


@_compiled
def _rows_of_its_own(weight: Floats) -> int:
    """Return a network's number of rows in a minibatch; padding, of weight 0, follows them."""
    n = 0
    while n < len(weight) and weight[n] > 0:
        n += 1
    return n


@_compiled
def _surrogate_derivatives(
    log_ratios: Floats, advantages: Floats, share: Floats, clip: float, ratios: Floats,
    exponents: NDArray[np.int32], powers: Floats, n: int, shares: Floats,
) -> None:  # fmt: skip
    """Replace the advantages (n,) by d loss / d log-probability.

    The loss is PPO's, or A2C's if `clip` is below 0. PPO adds the approximate KL divergence and the share of
    clipped ratios to `shares` (3,), first and third.
    """
    if clip < 0:
        for t in range(n):
            advantages[t] *= -share[t]
        return
    low, high = np.float32(1 - clip), np.float32(1 + clip)
    for t in range(n):
        ratios[t] = log_ratios[t]
    _exp(ratios, exponents, powers, n)
    kl, clipped = _ZERO, _ZERO
    for t in range(n):
        ratio = ratios[t]
        kl += share[t] * (ratio - _ONE - log_ratios[t])
        clipped += share[t] if ratio < low or ratio > high else _ZERO
        bounded = low if ratio < low else ratio
        bounded = high if bounded > high else bounded
        gained = ratio * advantages[t]
        advantages[t] = _ZERO if gained > bounded * advantages[t] else -share[t] * gained
    shares[0] += kl
    shares[2] += clipped


@_compiled
def learn_gaussian(
    values: Floats,
    gradient: Floats,
    form: NDArray[np.int64],
    relu: bool,
    held: Floats,
    signals: Floats,
    scratch: Floats,
    bits: NDArray[np.int32],
    powers: Floats,
    index: NDArray[np.int64],
    weight: Floats,
    rows: Floats,
    log_probs: Floats,
    advantages: Floats,
    old_means: Floats,
    kl_coeff: Floats,
    clip: float,
    entropy_coeff: float,
    shares: Floats,
    actions: Floats,
    log_std_at: int,
    old_log_std: Floats,
) -> None:
    """Add the gradients of PPO's or A2C's loss on rows `index` (P, n), with `weight` (P, n), of `rows` (P B,
    ...).

    Adds the approximate KL divergence, the entropy and the share of clipped ratios to `shares` (P, 3). Log
    standard deviations are at offset `log_std_at` of a network's values; `old_means` (P B, A) is empty
    without a KL penalty.
    """
    penalised, size, half_log_2pi = len(old_means) > 0, form[-1, 1], np.float32(0.5 * math.log(2 * math.pi))
    top = form[:, 0].sum()
    log_ratios, pulls, ratios = scratch[0], scratch[1], scratch[2]
    for p in range(len(index)):
        log_std, log_std_gradient = values[p, log_std_at:], gradient[p, log_std_at:]
        entropy = _ZERO
        for a in range(size):
            entropy += log_std[a] + half_log_2pi + _HALF
        rows_here = _rows_of_its_own(weight[p])
        parts = (rows_here + ROWS - 1) // ROWS
        for part in range(parts):
            start = rows_here * part // parts
            n = rows_here * (part + 1) // parts - start
            places, share = index[p, start : start + n], weight[p, start : start + n]
            _forward(values[p], form, relu, held, rows, places)
            for t in range(n):
                log_ratios[t], pulls[t] = -log_probs[places[t]], advantages[places[t]]
            for a in range(size):
                mean, standard = held[top + a], signals[len(form) % 2, a]
                inverse, constant = np.float32(math.exp(-log_std[a])), log_std[a] + half_log_2pi
                for t in range(n):
                    standard[t] = (actions[places[t], a] - mean[t]) * inverse
                    log_ratios[t] -= _HALF * standard[t] * standard[t] + constant
            _surrogate_derivatives(log_ratios, pulls, share, clip, ratios, bits, powers, n, shares[p])
            total = _ZERO
            for t in range(n):
                total += share[t]
            shares[p, 1] += total * entropy
            for a in range(size):
                mean, standard = held[top + a], signals[len(form) % 2, a]
                inverse, of_log_std = np.float32(math.exp(-log_std[a])), -np.float32(entropy_coeff) * total
                for t in range(n):
                    of_log_std += pulls[t] * (standard[t] * standard[t] - _ONE)
                    standard[t] *= pulls[t] * inverse
                if penalised:
                    ratio = np.float32(math.exp(2 * (old_log_std[p, a] - log_std[a])))
                    for t in range(n):
                        shift = (mean[t] - old_means[places[t], a]) * inverse
                        standard[t] += kl_coeff[p] * share[t] * shift * inverse
                        of_log_std += kl_coeff[p] * share[t] * (_ONE - ratio - shift * shift)
                log_std_gradient[a] += of_log_std
            _backward(values[p], form, relu, held, signals, gradient[p], n)


_FORBIDDEN = np.float32(np.finfo(np.float32).min / 4)


@_compiled
def _normalise(
    logits: Floats,
    probabilities: Floats,
    scale: Floats,
    bits: NDArray[np.int32],
    powers: Floats,
    size: int,
    n: int,
) -> None:
    """Turn logits (A, n) into log-probabilities, and write the probabilities to `probabilities`."""
    for t in range(n):
        scale[t] = logits[0, t]
    for a in range(1, size):
        for t in range(n):
            scale[t] = logits[a, t] if logits[a, t] > scale[t] else scale[t]
    for a in range(size):
        for t in range(n):
            logits[a, t] -= scale[t]
            probabilities[a, t] = logits[a, t]
        _exp(probabilities[a], bits, powers, n)
    for t in range(n):
        scale[t] = probabilities[0, t]
    for a in range(1, size):
        for t in range(n):
            scale[t] += probabilities[a, t]
    for a in range(size):
        for t in range(n):
            probabilities[a, t] /= scale[t]
    for t in range(n):
        scale[t] = math.log(scale[t])
    for a in range(size):
        for t in range(n):
            logits[a, t] -= scale[t]


@_compiled
def learn_categorical(
    values: Floats,
    gradient: Floats,
    form: NDArray[np.int64],
    relu: bool,
    held: Floats,
    signals: Floats,
    scratch: Floats,
    bits: NDArray[np.int32],
    powers: Floats,
    index: NDArray[np.int64],
    weight: Floats,
    rows: Floats,
    log_probs: Floats,
    advantages: Floats,
    old_probabilities: Floats,
    kl_coeff: Floats,
    clip: float,
    entropy_coeff: float,
    shares: Floats,
    actions: NDArray[np.int64],
    masks: NDArray[np.bool_],
) -> None:
    """Add the gradients of PPO's or A2C's loss on rows `index` (P, n), with `weight` (P, n), of `rows` (P B,
    ...).

    Adds the approximate KL divergence, the entropy and the share of clipped ratios to `shares` (P, 3).
    `masks` (P B, A) is empty if all actions are allowed, `old_probabilities` (P B, A) without a KL penalty.
    """
    masked, penalised, size = len(masks) > 0, len(old_probabilities) > 0, form[-1, 1]
    top, bonus = form[:, 0].sum(), np.float32(entropy_coeff)
    log_ratios, pulls, ratios, scales, entropies = scratch[0], scratch[1], scratch[2], scratch[3], scratch[4]
    for p in range(len(index)):
        rows_here = _rows_of_its_own(weight[p])
        parts = (rows_here + ROWS - 1) // ROWS
        for part in range(parts):
            start = rows_here * part // parts
            n = rows_here * (part + 1) // parts - start
            places, share = index[p, start : start + n], weight[p, start : start + n]
            logits, probabilities = held[top:], signals[len(form) % 2]
            _forward(values[p], form, relu, held, rows, places)
            if masked:
                for t in range(n):
                    for a in range(size):
                        if not masks[places[t], a]:
                            logits[a, t] = _FORBIDDEN
            _normalise(logits, probabilities, scales, bits, powers, size, n)
            for t in range(n):
                r = places[t]
                log_ratios[t], pulls[t] = logits[actions[r], t] - log_probs[r], advantages[r]
                entropies[t] = _ZERO
            for a in range(size):
                for t in range(n):
                    entropies[t] -= probabilities[a, t] * logits[a, t]
            _surrogate_derivatives(log_ratios, pulls, share, clip, ratios, bits, powers, n, shares[p])
            total = _ZERO
            for t in range(n):
                total += share[t] * entropies[t]
            shares[p, 1] += total
            if penalised:
                for t in range(n):
                    ratios[t] = kl_coeff[p] * share[t]
            else:
                for t in range(n):
                    ratios[t] = _ZERO
            for a in range(size):
                for t in range(n):
                    probabilities[a, t] *= (
                        bonus * share[t] * (logits[a, t] + entropies[t]) - pulls[t] + ratios[t]
                    )
            for t in range(n):
                probabilities[actions[places[t]], t] += pulls[t]
                if penalised:
                    for a in range(size):
                        probabilities[a, t] -= ratios[t] * old_probabilities[places[t], a]
            _backward(values[p], form, relu, held, signals, gradient[p], n)


@_compiled
def learn_returns(
    values: Floats,
    gradient: Floats,
    form: NDArray[np.int64],
    relu: bool,
    held: Floats,
    signals: Floats,
    scratch: Floats,
    bits: NDArray[np.int32],
    powers: Floats,
    index: NDArray[np.int64],
    weight: Floats,
    rows: Floats,
    taken: NDArray[np.int64],
    targets: Floats,
    most: float,
    losses: Floats,
) -> None:
    """Add the gradients of squared errors, bounded by `most`, on rows `index` (P, n) of `rows` (P B, ...).

    Adds the mean, by `weight` (P, n), to `losses` (P,). `taken` (P B,) selects the trained outputs; empty if
    there is only one.
    """
    chosen = len(taken) > 0
    top = form[:, 0].sum()
    for p in range(len(index)):
        rows_here = _rows_of_its_own(weight[p])
        parts = (rows_here + ROWS - 1) // ROWS
        for part in range(parts):
            start = rows_here * part // parts
            n = rows_here * (part + 1) // parts - start
            places = index[p, start : start + n]
            _forward(values[p], form, relu, held, rows, places)
            for t in range(n):
                r, share = places[t], weight[p, start + t]
                for a in range(form[-1, 1]):
                    signals[len(form) % 2, a, t] = _ZERO
                output = taken[r] if chosen else 0
                difference = held[top + output, t] - targets[r]
                error, derivative = difference * difference, 2 * difference * share
                if error > most:
                    error, derivative = most, 0.0
                signals[len(form) % 2, output, t] = derivative
                losses[p] += share * error
            _backward(values[p], form, relu, held, signals, gradient[p], n)


@_compiled
def adam(
    values: Floats,
    gradient: Floats,
    means: Floats,
    squares: Floats,
    counts: NDArray[np.int64],
    active: NDArray[np.bool_],
    lr: float,
    bound: float,
    decays: tuple[float, float],
    epsilon: float,
    norms: Floats,
) -> None:
    """Take Adam's step of the `active` (P,) networks (P, V), after `counts` (P,) steps so far.

    Gradient norms are clipped at `bound` and written to `norms` (P,), 0 for inactive networks.
    """
    one = values.dtype.type(1)
    first, second = values.dtype.type(decays[0]), values.dtype.type(decays[1])
    least = values.dtype.type(epsilon)
    for p in range(len(values)):
        norms[p] = 0
        if not active[p]:
            continue
        v, g, m, s = values[p], gradient[p], means[p], squares[p]
        total = g[0] * g[0]
        for i in range(1, len(g)):
            total += g[i] * g[i]
        norm = math.sqrt(total)
        norms[p] = norm
        # Written so that a NaN norm makes the share NaN, as in torch.
        limit = bound / (norm + 1e-6) if bound < math.inf else 1.0
        share = values.dtype.type(1.0 if limit >= 1 else limit)
        count = counts[p] + 1
        step = values.dtype.type(lr / (1 - decays[0] ** count))
        scale = values.dtype.type(math.sqrt(1 - decays[1] ** count))
        for i in range(len(v)):
            clipped = g[i] * share
            m[i] = first * m[i] + (one - first) * clipped
            s[i] = second * s[i] + (one - second) * clipped * clipped
            v[i] -= step * m[i] / (math.sqrt(s[i]) / scale + least)
        counts[p] = count


def warm() -> None:
    """Compile all kernels, or load them from the cache, by calling them with empty minibatches."""
    form = np.zeros((1, 4), np.int64)
    counts, active, indices = np.zeros(1, np.int64), np.ones(1, np.bool_), np.zeros((1, 0), np.int64)
    for dtype in (np.float32, np.float64):
        of, norms = np.zeros((1, 1), dtype), np.zeros(1, dtype)
        adam(of, of, of, of, counts, active, 0.0, math.inf, (0.0, 0.0), 1.0, norms)
    table, row, signals, held = (
        np.zeros(shape, np.float32) for shape in ((1, 1), 1, (2, 1, LANES), (1, LANES))
    )
    bits = np.zeros(1, np.int32)
    begin = (
        table, table, form, False, held, signals, np.zeros((SCRATCH, 1), np.float32),
        bits, bits.view(np.float32), indices, np.zeros((1, 0), np.float32), table,
    )  # fmt: skip
    common = (row, row, table, row, 0.0, 0.0, np.zeros((1, 3), np.float32))
    learn_gaussian(*begin, *common, table, 0, table)
    learn_categorical(*begin, *common, counts, np.ones((1, 1), np.bool_))
    learn_returns(*begin, counts, row, 0.0, row)
