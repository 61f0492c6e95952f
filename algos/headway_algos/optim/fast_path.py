"""Minibatch training with compiled kernels: multilayer perceptrons in float32 on a CPU."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from headway_algos.batches.layout import Piece
from headway_algos.batches.policy_batch import PolicyBatch
from headway_algos.config import AlgoConfig
from headway_algos.networks.actor import Actor
from headway_algos.networks.distributions import MaskedCategorical
from headway_algos.networks.gru import Network
from headway_algos.networks.mlp import StackedMLP
from headway_algos.optim.adam import StackedAdam
from headway_algos.optim.gradient_steps import Learn

ENABLED = True
"""False: train everything with torch, so that tests and benchmarks can compare."""


@dataclass(frozen=True)
class Perceptrons:
    """P stacked multilayer perceptrons, with the arrays that kernels work on."""

    values: NDArray[Any]
    """(P, V): all parameters."""
    gradient: NDArray[Any]
    """(P, V): their gradients."""
    form: NDArray[np.int64]
    """(L, 4): per layer, number of inputs, number of outputs, offsets of weights and of biases."""
    relu: bool
    held: NDArray[Any]
    """(F, ROWS): buffer for the inputs of each layer, then the outputs."""
    signals: NDArray[Any]
    """(2, W, ROWS): buffer for backpropagated gradients."""
    scratch: NDArray[Any]
    """(SCRATCH, ROWS): buffer for the losses."""
    bits: NDArray[np.int32]
    """(ROWS,): buffer for the exponents of floating-point numbers."""

    @classmethod
    def of(cls, network: Network, optimiser: StackedAdam) -> Self | None:
        """Return the arrays of a stack of networks, or None if torch is to be used."""
        values, gradient = optimiser.values.whole, optimiser.gradient.whole
        compiled = ENABLED and not values.is_cuda and values.dtype == torch.float32
        if not compiled or not isinstance(network, StackedMLP):
            return None
        from headway_algos.optim.kernel import ROWS, SCRATCH

        form = np.array([(w.shape[2], w.shape[1], *optimiser.starts((w, b))) for w, b in network.by_layer()])
        held = np.empty((form[0, 0] + form[:, 1].sum(), ROWS), np.float32)
        signals = np.empty((2, form[:, 1].max(), ROWS), np.float32)
        scratch, bits = np.empty((SCRATCH, ROWS), np.float32), np.empty(ROWS, np.int32)
        relu = network.activation == "relu"
        return cls(values.numpy(), gradient.numpy(), form, relu, held, signals, scratch, bits)

    def learn(self, kernel: Callable[..., None], piece: Piece, *others: object) -> None:
        """Call a kernel with the arguments common to all kernels, then `others`."""
        index, weight = (np.ascontiguousarray(tensor.numpy()) for tensor in (piece.index, piece.weight))
        kernel(
            self.values, self.gradient, self.form, self.relu, self.held, self.signals,
            self.scratch, self.bits, self.bits.view(np.float32), index, weight, *others,
        )  # fmt: skip


def _flat(rows: Tensor | None, like: NDArray[Any]) -> NDArray[Any]:
    """Return rows (P, B, ...) as an array (P B, ...) with the dtype of the empty array `like`, or `like`."""
    if rows is None:
        return like
    array: NDArray[Any] = np.ascontiguousarray(rows.detach().numpy(), dtype=like.dtype)
    return array.reshape(-1, *array.shape[2:])


def policy_gradients(
    actor: Actor,
    optimiser: StackedAdam,
    rows: PolicyBatch,
    advantages: Tensor,
    old: tuple[Tensor | None, Tensor | None],
    kl_coeff: Tensor,
    entropy_coeff: float,
    clip: float | None,
) -> Learn | None:
    """Return the compiled gradients of PPO's loss, or of A2C's if `clip` is None. None: use torch.

    They report the approximate KL divergence, the entropy and the share of clipped ratios. `old` are the
    network outputs (P, B, A) of the policies that acted, None without a KL penalty, and their log standard
    deviations (P, A, 1).
    """
    networks = Perceptrons.of(actor.network, optimiser)
    if networks is None:
        return None
    from headway_algos.optim import kernel

    old_outputs, old_log_std = old
    numbers, outputs = np.empty(0, np.float32), int(networks.form[-1, 1])
    table = numbers.reshape(0, outputs)
    if old_outputs is not None:
        before = actor.distribution(old_outputs.transpose(1, 2), rows.masks)
        if isinstance(before, MaskedCategorical):
            old_outputs = before.log_probs.exp().transpose(1, 2)
    common = (
        _flat(rows.observations, table), _flat(rows.log_probs, numbers), _flat(advantages, numbers),
        _flat(old_outputs, table), kl_coeff.numpy(),
        -1.0 if clip is None else float(clip), float(entropy_coeff),
    )  # fmt: skip
    learn: Callable[..., None]
    its_own: tuple[Any, ...]
    if actor.log_std is None or old_log_std is None:
        masks = _flat(rows.masks, np.empty((0, outputs), np.bool_))
        learn, its_own = kernel.learn_categorical, (_flat(rows.actions, np.empty(0, np.int64)), masks)
    else:
        (begins,) = optimiser.starts([actor.log_std])
        past = np.ascontiguousarray(old_log_std[..., 0].numpy())
        learn, its_own = kernel.learn_gaussian, (_flat(rows.actions, table), begins, past)

    def of_piece(piece: Piece) -> Tensor:
        shares = np.zeros((len(networks.values), 3), np.float32)
        networks.learn(learn, piece, *common, shares, *its_own)
        return torch.from_numpy(shares.T)

    return of_piece


def regression(
    network: Network,
    optimiser: StackedAdam,
    inputs: Tensor,
    taken: Tensor | None,
    targets: Tensor,
    config: AlgoConfig,
) -> Learn | None:
    """Return the compiled gradients of `squared_error`, or None if torch is to be used.

    Arguments are inputs (P, B, D), the index (P, B) of the trained output (None with one output) and targets
    (P, B).
    """
    networks = Perceptrons.of(network, optimiser)
    if networks is None:
        return None
    from headway_algos.optim import kernel

    numbers, most = (
        np.empty(0, np.float32),
        float("inf") if config.value_clip is None else float(config.value_clip),
    )
    of_rows = (
        _flat(inputs, numbers), _flat(taken, np.empty(0, np.int64)), _flat(targets, numbers), most,
    )  # fmt: skip

    def of_piece(piece: Piece) -> Tensor:
        losses = np.zeros((1, len(networks.values)), np.float32)
        networks.learn(kernel.learn_returns, piece, *of_rows, losses[0])
        return torch.from_numpy(losses)

    return of_piece
