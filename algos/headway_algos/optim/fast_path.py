"""Minibatch training with compiled kernels, where faster than torch: small float32 perceptrons on a CPU."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from headway_algos.batches.layout import Piece
from headway_algos.batches.policy_batch import PolicyBatch
from headway_algos.config import AlgoConfig
from headway_algos.networks.actor import Actor
from headway_algos.networks.gru import Network
from headway_algos.networks.mlp import StackedMLP
from headway_algos.optim.adam import StackedAdam

MOST_PRODUCTS = 1_500_000
"""Maximum product of minibatch rows and weights, per network, for which the kernels are used. Beyond it, the
faster matrix products of torch's library outweigh its call overhead."""

Learn = Callable[[Piece], Tensor]
"""Adds a piece's gradients and returns its shares of the metrics."""


def uncut(config: AlgoConfig) -> AlgoConfig:
    """Return the config with minibatches in one piece: kernels split each network's rows themselves."""
    return replace(config, piece_samples=2**62)


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

    @classmethod
    def of(cls, network: Network, optimiser: StackedAdam, rows: int, minibatches: int) -> Self | None:
        """Return the arrays of a network, or None if torch is faster or required.

        `rows`: rows of all minibatches of a pass.
        """
        values, gradient = optimiser.values.whole, optimiser.gradient.whole
        if not isinstance(network, StackedMLP) or values.is_cuda or values.dtype != torch.float32:
            return None
        if rows / minibatches * sum(weight[0].numel() for weight, _ in network.by_layer()) > MOST_PRODUCTS:
            return None
        from headway_algos.optim.kernel import ROWS

        form = np.array([(w.shape[2], w.shape[1], *optimiser.starts((w, b))) for w, b in network.by_layer()])
        held = np.empty((form[0, 0] + form[:, 1].sum(), ROWS), np.float32)
        signals = np.empty((2, form[:, 1].max(), ROWS), np.float32)
        return cls(values.numpy(), gradient.numpy(), form, network.activation == "relu", held, signals)

    def learn(self, kernel: Callable[..., None], piece: Piece, *others: object) -> None:
        """Call a kernel with the arguments common to all kernels, then `others`."""
        index, weight = (np.ascontiguousarray(tensor.numpy()) for tensor in (piece.index, piece.weight))
        kernel(
            self.values, self.gradient, self.form, self.relu, self.held, self.signals, index, weight, *others
        )


def _flat(rows: Tensor | None, like: NDArray[Any]) -> NDArray[Any]:
    """Return rows (P, B, ...) as an array (P B, ...) with the dtype of the empty array `like`, or `like`."""
    if rows is None:
        return like
    array: NDArray[Any] = np.ascontiguousarray(rows.detach().numpy(), dtype=like.dtype)
    return array.reshape(-1, *array.shape[2:])


def surrogate(
    actor: Actor,
    optimiser: StackedAdam,
    rows: PolicyBatch,
    advantages: Tensor,
    old: tuple[Tensor | None, Tensor | None],
    kl_coeff: Tensor,
    config: AlgoConfig,
) -> Learn | None:
    """Return the compiled equivalent of `PPO._learn`, or None if torch is to be used.

    `old`: network outputs (P, B, A), None without a KL penalty, and log standard deviations (P, A, 1).
    """
    networks = Perceptrons.of(actor.network, optimiser, rows.selected.shape[1], config.minibatches)
    if networks is None:
        return None
    from headway_algos.optim import kernel

    old_outputs, old_log_std = old
    numbers, outputs = np.empty(0, np.float32), int(networks.form[-1, 1])
    table = numbers.reshape(0, outputs)
    common = (
        _flat(rows.observations, table), _flat(rows.log_probs, numbers), _flat(advantages, numbers),
        _flat(old_outputs, table), kl_coeff.numpy(), float(config.clip), float(config.entropy_coeff),
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
    """Return the compiled equivalent of `ReturnRegression._learn`, or None if torch is to be used.

    Arguments are inputs (P, B, D), the index (P, B) of the trained output (None with one output) and targets
    (P, B).
    """
    networks = Perceptrons.of(network, optimiser, inputs.shape[1], config.minibatches)
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
        losses = np.zeros(len(networks.values), np.float32)
        networks.learn(kernel.learn_returns, piece, *of_rows, losses)
        return torch.from_numpy(losses)

    return of_piece
