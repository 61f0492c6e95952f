"""Fisher-vector products for a stack of policies.

F = E[J^T M J] over the rows, where J is the Jacobian of the network's outputs in the parameters and M the
Fisher information of the action distribution in those outputs. F is the Hessian of the mean KL(pi_old || pi)
at pi = pi_old (Schulman et al. 2015, arXiv:1502.05477, appendix C; Pascanu and Bengio 2013, arXiv:1301.3584).

Vectors (P, V) concatenate all parameters of a policy.
"""

from collections.abc import Callable, Iterable, Sequence

import torch
from torch import Tensor

from headway_algos.batches.whole_batch import WholeBatch
from headway_algos.networks.actor import Actor
from headway_algos.networks.distributions import DiagonalGaussian
from headway_algos.networks.linearised import LinearisedMLP
from headway_algos.networks.mlp import StackedMLP

FisherProduct = Callable[[Tensor], Tensor]
"""v (P, V) -> F v (P, V)."""


def flat(tensors: Iterable[Tensor]) -> Tensor:
    """Concatenate tensors (P, ...) to (P, V)."""
    return torch.cat([tensor.flatten(1) for tensor in tensors], dim=1)


def unflat(vector: Tensor, like: Sequence[Tensor]) -> list[Tensor]:
    """Split a vector (P, V) into views shaped like `like`: the inverse of `flat`."""
    widths = [tensor[0].numel() for tensor in like]
    parts = torch.split(vector, widths, dim=1)
    return [part.view(len(vector), *t.shape[1:]) for part, t in zip(parts, like, strict=True)]


def fisher_product(actor: Actor, batch: WholeBatch, piece_samples: int) -> FisherProduct:
    """Return the product at the actor's current parameters over the batch, by the fastest method."""
    if isinstance(actor.network, StackedMLP):
        return gauss_newton(actor, batch, piece_samples)
    return double_backward(actor, batch, piece_samples)


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
        direction = unflat(vector, parameters)
        result = torch.zeros_like(vector)
        parts = unflat(result, parameters)
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
            gradient = flat(torch.autograd.grad(mean_kl, parameters, create_graph=True))
            result += flat(torch.autograd.grad((gradient * vector).sum(), parameters))
        return result

    return product
