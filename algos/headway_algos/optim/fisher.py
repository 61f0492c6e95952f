"""Fisher-vector products for a stack of policies.

F = E[J^T M J] over the rows, where J is the Jacobian of the network's outputs in the parameters and M the
Fisher information of the action distribution in those outputs. F is the Hessian of the mean KL(pi_old || pi)
at pi = pi_old (Schulman et al. 2015, arXiv:1502.05477, appendix C; Pascanu and Bengio 2013, arXiv:1301.3584).

Vectors (P, V) concatenate all parameters of a policy.
"""

from collections.abc import Callable, Iterable, Sequence
from itertools import accumulate

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad

from headway_algos.batches.whole_batch import WholeBatch
from headway_algos.kernels.jacobian import add_transposed_jacobian, multiply_jacobian, store_activations
from headway_algos.kernels.perceptron import ROWS
from headway_algos.networks.actor import Actor
from headway_algos.networks.distributions import DiagonalGaussian
from headway_algos.networks.linearised import LinearisedMLP
from headway_algos.networks.mlp import StackedMLP
from headway_algos.optim.fast_path import kernel_networks_at

FisherProduct = Callable[[Tensor], Tensor]
"""v (P, V) -> F v (P, V)."""


def to_vector(tensors: Iterable[Tensor]) -> Tensor:
    """Concatenate tensors (P, ...) to (P, V)."""
    return torch.cat([tensor.flatten(1) for tensor in tensors], dim=1)


def from_vector(vector: Tensor, like: Sequence[Tensor]) -> list[Tensor]:
    """Split a vector (P, V) into views shaped like `like`: the inverse of `to_vector`."""
    widths = [tensor[0].numel() for tensor in like]
    parts = torch.split(vector, widths, dim=1)
    return [part.view(len(vector), *t.shape[1:]) for part, t in zip(parts, like, strict=True)]


def fisher_product(actor: Actor, batch: WholeBatch, piece_samples: int) -> FisherProduct:
    """Return the product at the actor's current parameters over the batch, by the fastest method."""
    if isinstance(actor.network, StackedMLP):
        return compiled_gauss_newton(actor, batch) or gauss_newton(actor, batch, piece_samples)
    return double_backward(actor, batch, piece_samples)


def compiled_gauss_newton(actor: Actor, batch: WholeBatch) -> FisherProduct | None:
    """Return v -> J^T M J v by compiled kernels, or None if torch is to be used; see `fast_path`."""
    parameters = actor.learnable
    values = to_vector(parameter.detach() for parameter in parameters)
    result = torch.zeros_like(values)
    ends = accumulate(parameter[0].numel() for parameter in parameters)
    starts = {id(p): end - p[0].numel() for p, end in zip(parameters, ends, strict=True)}
    networks = kernel_networks_at(actor.network, values, result, lambda some: [starts[id(p)] for p in some])
    if networks is None:
        return None
    stack, width, inputs = batch.observations.shape
    counts = (batch.weight > 0).sum(1).numpy()
    blocks, features = -(-width // ROWS), len(networks.activations)
    # Whole blocks: torch may compute the last lanes of a tensor differently, to the last bits.
    stored = np.zeros((stack, blocks, features, ROWS), np.float32)
    none = blocks * ROWS - width
    weight = pad(batch.weight, (0, none))[:, None]
    masks = None if batch.masks is None else pad(batch.masks, (0, 0, 0, none), value=True)
    index = np.arange(stack * width).reshape(stack, width)
    rows = batch.observations.contiguous().numpy().reshape(stack * width, inputs)
    store_activations(networks, rows, index, counts, stored)
    size = networks.outputs
    outputs = stored[:, :, -size:].swapaxes(1, 2).reshape(stack, size, blocks * ROWS)
    with torch.no_grad():
        distribution = actor.distribution(torch.from_numpy(outputs), masks)
    changes = torch.zeros(stack, size, blocks * ROWS)
    has_rows = batch.has_rows.to(batch.weight.dtype).view(-1, 1)
    free = 0 if actor.log_std is None else parameters[0][0].numel()

    def product(vector: Tensor) -> Tensor:
        result.zero_()
        multiply_jacobian(networks, vector.contiguous().numpy(), stored, counts, changes.numpy())
        signals = distribution.fisher_of_outputs(changes) * weight
        add_transposed_jacobian(networks, signals.contiguous().numpy(), stored, counts)
        result[:, :free] = DiagonalGaussian.LOG_STD_FISHER * has_rows * vector[:, :free]
        return result.clone()

    return product


def gauss_newton(actor: Actor, batch: WholeBatch, piece_samples: int) -> FisherProduct:
    """Return v -> J^T M J v, for multilayer perceptrons; the network is evaluated only once."""
    pieces = list(batch.pieces(piece_samples))
    network = actor.network
    assert isinstance(network, StackedMLP)
    linear = [LinearisedMLP.of(network, piece.observations) for piece in pieces]
    with torch.no_grad():
        distributions = [
            actor.distribution(network.outputs, piece.masks)
            for network, piece in zip(linear, pieces, strict=True)
        ]
    parameters = [parameter.detach() for parameter in actor.learnable]
    has_rows = batch.has_rows.to(batch.weight.dtype).view(-1, 1, 1)

    def product(vector: Tensor) -> Tensor:
        direction = from_vector(vector, parameters)
        result = torch.zeros_like(vector)
        parts = from_vector(result, parameters)
        if actor.log_std is not None:
            parts[0] += DiagonalGaussian.LOG_STD_FISHER * has_rows * direction[0]
            direction, parts = direction[1:], parts[1:]
        for network, distribution, piece in zip(linear, distributions, pieces, strict=True):
            signal = distribution.fisher_of_outputs(network.jvp(direction)) * piece.weight[:, None]
            for part, gradient in zip(parts, network.vjp(signal), strict=True):
                part += gradient
        return result

    return product


def double_backward(actor: Actor, batch: WholeBatch, piece_samples: int) -> FisherProduct:
    """Return v -> d (v . d mean KL / d theta) / d theta, by automatic differentiation, for any network."""
    parameters = actor.learnable

    def product(vector: Tensor) -> Tensor:
        result = torch.zeros_like(vector)
        for piece in batch.pieces(piece_samples):
            new = actor(piece.observations, piece.masks, piece.timeline)
            mean_kl = (new.kl_from(new.detach()) * piece.weight).sum()
            gradient = to_vector(torch.autograd.grad(mean_kl, parameters, create_graph=True))
            result += to_vector(torch.autograd.grad((gradient * vector).sum(), parameters))
        return result

    return product
