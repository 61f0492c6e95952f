"""Minibatch steps of Adam down the losses of policies and critics, for stacks of perceptrons.

For the equations see the torch equivalents, against which the kernels are tested: `PPOLoss` and `A2CLoss` in
`on_policy.updates.losses`, `squared_error` in `on_policy.critics.return_regression`. The networks of a stack
are trained one after another, each on its own rows, so that a network's result does not depend on its stack
and its parameters, moments and data stay in the cache for several minibatches.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from headway.contracts.numba_setup import compiled_with
from headway_algos.kernels.adam import Adam, step_network
from headway_algos.kernels.compiled import HALF, ONE, ZERO, Floats, compiled
from headway_algos.kernels.perceptron import ROWS, Perceptrons, backward, forward
from headway_algos.kernels.products import TILE

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
_LEAST, _MOST = np.float32(-87), np.float32(88)


def _exp_by_parts(row: Floats, bits: NDArray[np.int32], powers: Floats, n: int) -> None:
    """Replace x by exp(x): by 0 if x < -87, by exp(88) if x > 88. `powers` (ROWS,) shares its memory with
    `bits`."""
    for t in range(n):
        x = row[t]
        below = x < _LEAST
        x = _MOST if x > _MOST else x
        k = np.floor(x * _LOG2_E + HALF)
        r = x - k * _LN2_HIGH
        r = r - k * _LN2_LOW
        e = ((((_E[5] * r + _E[4]) * r + _E[3]) * r + _E[2]) * r + _E[1]) * r + _E[0]
        row[t] = e * r * r + r + ONE
        bits[t] = 0 if below else (np.int32(k) + 127) << 23
    for t in range(n):
        row[t] = ZERO if bits[t] == 0 else row[t] * powers[t]


# Not "reassoc": merging the two subtractions of k log(2) would lose the last digits of the remainder.
exp = compiled_with(_exp_by_parts, _nrt=False, fastmath={"contract"})


class RowIndices(NamedTuple):
    """S minibatches for each of P networks, of at most W rows."""

    rows: NDArray[np.int64]
    """(S, P, W): indices of rows (P B), padded."""
    sizes: NDArray[np.int64]
    """(S, P): number of rows; a network takes no step with 0."""


class PolicyData(NamedTuple):
    """Experience of P policies for the losses of PPO and A2C."""

    observations: Floats
    """(P B, D)"""
    log_probs: Floats
    """(P B,), when the actions were sampled."""
    advantages: Floats
    """(P B,)"""
    old_outputs: Floats
    """(P B, A): means, or probabilities, of the policies that acted; empty without a KL penalty."""
    kl_coeff: Floats
    """(P,)"""
    clipped: bool
    """PPO's clipped surrogate; False: A2C's loss."""
    clip: float
    """Clip range of PPO's ratio; unused by A2C."""
    entropy_coeff: float


class DiscreteActions(NamedTuple):
    """Discrete actions."""

    actions: NDArray[np.int64]
    """(P B,)"""
    masks: NDArray[np.bool_]
    """(P B, A); empty if all actions are allowed."""


class BoxActions(NamedTuple):
    """Box actions of Gaussian policies."""

    actions: Floats
    """(P B, A)"""
    old_log_std: Floats
    """(P, A)"""
    log_std_at: int
    """Offset of the log standard deviations among the values of a network."""


class Targets(NamedTuple):
    """Data of the regression of P critics."""

    inputs: Floats
    """(P B, D)"""
    taken: NDArray[np.int64]
    """(P B,): the trained output of each row; empty if there is only one."""
    targets: Floats
    """(P B,)"""
    bound: float
    """Squared errors above it count as this constant."""


_LOG_RATIO, _ADVANTAGE, _RATIO, _SCALE, _ENTROPY = range(5)
"""Rows of `Perceptrons.scratch`, by the quantity that each holds while a policy is trained."""


@compiled
def _clear_gradient(net: Perceptrons, p: int) -> None:
    """Set the gradient of network p to 0."""
    for i in range(net.gradient.shape[1]):
        net.gradient[p, i] = ZERO


@compiled
def _rows_per_pass(n: int) -> int:
    """Return how many rows of a minibatch pass through a network together: equal parts of whole tiles."""
    parts = (n + ROWS - 1) // ROWS
    return ((n + parts - 1) // parts + TILE - 1) // TILE * TILE


@compiled
def _surrogate_derivatives(
    net: Perceptrons, data: PolicyData, weight: np.float32, n: int, reported: Floats
) -> None:
    """Replace the advantages in `net.scratch` by d loss / d log-probability, given the log ratios there.

    PPO adds the approximate KL divergence and the share of clipped ratios to `reported` (3,), first and
    third.
    """
    log_ratios, advantages, ratios = net.scratch[_LOG_RATIO], net.scratch[_ADVANTAGE], net.scratch[_RATIO]
    if not data.clipped:
        for t in range(n):
            advantages[t] *= -weight
        return
    low, high = np.float32(1 - data.clip), np.float32(1 + data.clip)
    for t in range(n):
        ratios[t] = log_ratios[t]
    exp(ratios, net.exponents, net.powers, n)
    kl, clipped = ZERO, ZERO
    for t in range(n):
        ratio = ratios[t]
        # Schulman's low-variance estimate, as in `PPOLoss`.
        kl += ratio - ONE - log_ratios[t]
        clipped += ONE if ratio < low or ratio > high else ZERO
        bounded = low if ratio < low else ratio
        bounded = high if bounded > high else bounded
        gained = ratio * advantages[t]
        # Where the clipped term is the smaller one, the loss is constant; elsewhere d ratio / d
        # log-probability is the ratio itself.
        advantages[t] = ZERO if gained > bounded * advantages[t] else -weight * gained
    reported[0] += weight * kl
    reported[2] += weight * clipped


@compiled
def _add_gaussian_gradient(
    net: Perceptrons, p: int, rows: NDArray[np.int64], weight: np.float32, data: PolicyData, box: BoxActions,
    reported: Floats,
) -> None:  # fmt: skip
    """Add the gradient of network p on `rows` (n,), each of weight `weight`, and its shares of the metrics to
    `reported`."""
    n, size, half_log_2pi = len(rows), net.layers[-1, 1], np.float32(0.5 * math.log(2 * math.pi))
    top, last = net.layers[:, 0].sum(), net.errors[len(net.layers) % 2]
    log_ratios, advantages = net.scratch[_LOG_RATIO], net.scratch[_ADVANTAGE]
    log_std, log_std_gradient = net.values[p, box.log_std_at :], net.gradient[p, box.log_std_at :]
    forward(net, p, data.observations, rows)
    for t in range(n):
        log_ratios[t], advantages[t] = -data.log_probs[rows[t]], data.advantages[rows[t]]
    for a in range(size):
        mean, standardised = net.activations[top + a], last[a]
        inverse, constant = np.float32(math.exp(-log_std[a])), log_std[a] + half_log_2pi
        for t in range(n):
            standardised[t] = (box.actions[rows[t], a] - mean[t]) * inverse
            log_ratios[t] -= HALF * standardised[t] * standardised[t] + constant
        # The entropy of a Gaussian depends on its spread only: it is the same for every row.
        reported[1] += weight * n * (constant + HALF)
    _surrogate_derivatives(net, data, weight, n, reported)
    log_prob_gradients = net.scratch[_ADVANTAGE]
    for a in range(size):
        mean, standardised = net.activations[top + a], last[a]
        inverse = np.float32(math.exp(-log_std[a]))
        # d entropy / d log std is 1.
        log_std_derivative = -np.float32(data.entropy_coeff) * weight * n
        for t in range(n):
            log_std_derivative += log_prob_gradients[t] * (standardised[t] * standardised[t] - ONE)
            # In place: `standardised` is the row of `net.errors` from which `backward` starts.
            standardised[t] *= log_prob_gradients[t] * inverse
        if len(data.old_outputs) > 0:
            # Derivatives of KL(old || new) by the new mean and log standard deviation.
            variance_ratio = np.float32(math.exp(2 * (box.old_log_std[p, a] - log_std[a])))
            kl_weight = data.kl_coeff[p] * weight
            for t in range(n):
                shift = (mean[t] - data.old_outputs[rows[t], a]) * inverse
                standardised[t] += kl_weight * shift * inverse
                log_std_derivative += kl_weight * (ONE - variance_ratio - shift * shift)
        log_std_gradient[a] += log_std_derivative
    backward(net, p, n)


# Far below any logit, but finite: -inf would make the entropy 0 x inf = NaN.
_FORBIDDEN = np.float32(np.finfo(np.float32).min / 4)


@compiled
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
            # Relative to the largest logit, so that exp cannot overflow.
            logits[a, t] -= scale[t]
            probabilities[a, t] = logits[a, t]
        exp(probabilities[a], bits, powers, n)
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


@compiled
def _add_categorical_gradient(
    net: Perceptrons, p: int, rows: NDArray[np.int64], weight: np.float32, data: PolicyData,
    discrete: DiscreteActions, reported: Floats,
) -> None:  # fmt: skip
    """Add the gradient of network p on `rows` (n,), each of weight `weight`, and its shares of the metrics to
    `reported`."""
    n, size, actions = len(rows), net.layers[-1, 1], discrete.actions
    top, probabilities = net.layers[:, 0].sum(), net.errors[len(net.layers) % 2]
    logits = net.activations[top:]
    log_ratios, advantages = net.scratch[_LOG_RATIO], net.scratch[_ADVANTAGE]
    scales, entropies = net.scratch[_SCALE], net.scratch[_ENTROPY]
    forward(net, p, data.observations, rows)
    if len(discrete.masks) > 0:
        for t in range(n):
            for a in range(size):
                if not discrete.masks[rows[t], a]:
                    logits[a, t] = _FORBIDDEN
    _normalise(logits, probabilities, scales, net.exponents, net.powers, size, n)
    for t in range(n):
        r = rows[t]
        log_ratios[t], advantages[t] = logits[actions[r], t] - data.log_probs[r], data.advantages[r]
        entropies[t] = ZERO
    for a in range(size):
        for t in range(n):
            entropies[t] -= probabilities[a, t] * logits[a, t]
    _surrogate_derivatives(net, data, weight, n, reported)
    log_prob_gradients = net.scratch[_ADVANTAGE]
    total = ZERO
    for t in range(n):
        total += entropies[t]
    reported[1] += weight * total
    penalised, bonus = len(data.old_outputs) > 0, np.float32(data.entropy_coeff) * weight
    kl_weight = data.kl_coeff[p] * weight if penalised else ZERO
    for a in range(size):
        for t in range(n):
            # d loss / d logit_a = p_a (c (log p_a + H) - g + k) + g [a = u] - k p_old_a, with g = d loss / d
            # log p(u), entropy bonus c and KL coefficient k; the last two terms are added below.
            probabilities[a, t] *= bonus * (logits[a, t] + entropies[t]) - log_prob_gradients[t] + kl_weight
    for t in range(n):
        probabilities[actions[rows[t]], t] += log_prob_gradients[t]
        if penalised:
            for a in range(size):
                probabilities[a, t] -= kl_weight * data.old_outputs[rows[t], a]
    backward(net, p, n)


@compiled
def _add_regression_gradient(
    net: Perceptrons, p: int, rows: NDArray[np.int64], weight: np.float32, data: Targets, reported: Floats
) -> None:
    """Add the gradient of network p on `rows` (n,), each of weight `weight`, and its shares of the metrics to
    `reported`."""
    n, chosen, bound, differences = len(rows), len(data.taken) > 0, np.float32(data.bound), net.scratch[0]
    top, last = net.layers[:, 0].sum(), net.errors[len(net.layers) % 2]
    forward(net, p, data.inputs, rows)
    for t in range(n):
        output = data.taken[rows[t]] if chosen else 0
        differences[t] = net.activations[top + output, t] - data.targets[rows[t]]
    total = ZERO
    for t in range(n):
        error = differences[t] * differences[t]
        total += bound if error > bound else error
        # Beyond the bound the loss is constant; elsewhere its derivative is twice the difference.
        differences[t] *= ZERO if error > bound else weight + weight
    reported[0] += weight * total
    for a in range(net.layers[-1, 1]):
        for t in range(n):
            # Values of actions that were not taken are not trained.
            last[a, t] = ZERO
    for t in range(n):
        last[data.taken[rows[t]] if chosen else 0, t] = differences[t]
    backward(net, p, n)


# The three loops below are alike. Numba cannot cache one loop that takes `_add_..._gradient` as an argument
# or encloses it: every process would compile it anew.
@compiled
def descend_gaussian(
    net: Perceptrons,
    adam: Adam,
    batches: RowIndices,
    data: PolicyData,
    box: BoxActions,
    reported: Floats,
    norms: Floats,
) -> None:
    """Step P Gaussian policies; add up the approximate KL divergence, the entropy and the share of clipped
    ratios of each minibatch in `reported` (P, 3), the norms of the gradients in `norms` (P,)."""
    for p in range(len(net.values)):
        for s in range(len(batches.rows)):
            n = batches.sizes[s, p]
            if n == 0:
                continue
            _clear_gradient(net, p)
            # The parts of a minibatch pass one after another, so that activations stay in the cache;
            # gradients add up.
            part, weight = _rows_per_pass(n), np.float32(1 / n)
            for start in range(0, n, part):
                rows = batches.rows[s, p, start : min(start + part, n)]
                _add_gaussian_gradient(net, p, rows, weight, data, box, reported[p])
            norms[p] += step_network(net.values[p], net.gradient[p], adam, p)


@compiled
def descend_categorical(
    net: Perceptrons,
    adam: Adam,
    batches: RowIndices,
    data: PolicyData,
    discrete: DiscreteActions,
    reported: Floats,
    norms: Floats,
) -> None:
    """Step P categorical policies; `reported` and `norms` as in `descend_gaussian`."""
    for p in range(len(net.values)):
        for s in range(len(batches.rows)):
            n = batches.sizes[s, p]
            if n == 0:
                continue
            _clear_gradient(net, p)
            part, weight = _rows_per_pass(n), np.float32(1 / n)
            for start in range(0, n, part):
                rows = batches.rows[s, p, start : min(start + part, n)]
                _add_categorical_gradient(net, p, rows, weight, data, discrete, reported[p])
            norms[p] += step_network(net.values[p], net.gradient[p], adam, p)


@compiled
def descend_returns(
    net: Perceptrons, adam: Adam, batches: RowIndices, data: Targets, reported: Floats, norms: Floats
) -> None:
    """Step P critics; add up the mean bounded squared error of each minibatch in `reported` (P, 1), the norms
    of the gradients in `norms` (P,)."""
    for p in range(len(net.values)):
        for s in range(len(batches.rows)):
            n = batches.sizes[s, p]
            if n == 0:
                continue
            _clear_gradient(net, p)
            part, weight = _rows_per_pass(n), np.float32(1 / n)
            for start in range(0, n, part):
                rows = batches.rows[s, p, start : min(start + part, n)]
                _add_regression_gradient(net, p, rows, weight, data, reported[p])
            norms[p] += step_network(net.values[p], net.gradient[p], adam, p)
