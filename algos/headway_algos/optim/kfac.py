"""Natural-gradient steps with Kronecker factors, within a trust region, for a stack of networks.

Source: Wu et al. 2017, arXiv:1708.05144.
"""

from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from headway.contracts import HeadwayError
from headway_algos.networks.distributions import DiagonalGaussian
from headway_algos.networks.linearised import LinearisedMLP
from headway_algos.networks.mlp import StackedMLP
from headway_algos.optim.config import KroneckerConfig
from headway_algos.optim.kronecker import KroneckerFactors, inner, joined

Information = Callable[[Tensor], Tensor]
"""v (P, O, B) -> M v (P, O, B), with M the Fisher information in the network's outputs, per row."""


@dataclass(frozen=True)
class Step:
    """Size and predicted KL divergence of a step, (P,) each; 0 for networks that took none."""

    size: Tensor
    """Eta, at most the learning rate."""
    predicted_kl: Tensor
    """1/2 eta^2 d^T F d, damping included; at most the bound."""


class StackedKFAC:
    """Optimiser by natural-gradient steps eta d, with d = F^-1 g, F in Kronecker factors (section 3), and

        eta = min(lr, sqrt(2 delta / d^T F d)),

    so that 1/2 eta^2 d^T F d, the KL divergence to second order, is at most delta. In eta the paper uses the
    factors as F, as does `kfac_length: factors`. But d favours directions in which the factors are small;
    they average over older batches and ignore correlations between layers, so the true divergence can be
    several times larger. The default is the exact F of the batch (as in section 6.4 of Martens and Grosse,
    arXiv:1503.05671), at the cost of one more pass. Either is damped, which bounds steps where F vanishes.

    With momentum, d is the running average mu d + (1 - mu) F^-1 g, and the bound holds for the step taken. A
    Gaussian's log standard deviation is part of d, with its exact Fisher information. The networks of the
    stack are independent.
    """

    def __init__(
        self,
        network: nn.Module,
        log_std: nn.Parameter | None,
        config: KroneckerConfig,
        lr: float,
        bound: float,
    ) -> None:
        """Raises HeadwayError for networks other than multilayer perceptrons."""
        self.network, self.log_std = _perceptrons(network), log_std
        self.lr, self.bound, self.share = lr, bound, 1.0
        self.damping, self.momentum = config.kfac_damping, config.kfac_momentum
        self.exact = config.kfac_length == "exact"
        self.pieces: list[tuple[LinearisedMLP, Information, Tensor]] = []
        self.factors = KroneckerFactors(
            self.network, config.kfac_damping, config.kfac_decay, config.kfac_every
        )
        self.direction = [
            torch.zeros_like(part) for part in self._parts([p.detach() for p in self._learnable])
        ]
        """d of the last step."""

    @property
    def _learnable(self) -> list[nn.Parameter]:
        return [*([] if self.log_std is None else [self.log_std]), *self.network.parameters()]

    def _parts(self, parameters: Sequence[Tensor]) -> list[Tensor]:
        """Return the log standard deviation, if any, then a matrix per layer: weights joined with biases."""
        first = 0 if self.log_std is None else 1
        return [*parameters[:first], *joined(parameters[first:])]

    def begin(self) -> None:
        """Start a new batch."""
        self.factors.begin()
        self.pieces.clear()

    def include(self, linear: LinearisedMLP, score: Tensor, information: Information, weight: Tensor) -> None:
        """Add a piece of the batch, linearised at the current parameters.

        `score`, `weight`: see `KroneckerFactors.include`. `information`: Fisher product of the outputs, used
        with `kfac_length: exact` only.
        """
        self.factors.include(linear, score, weight)
        if self.exact:
            self.pieces.append((linear, information, weight))

    def step(self, gradient: Sequence[Tensor], active: NDArray[np.bool_]) -> Step:
        """Take an ascent step of the `active` (P,) networks, those with rows in the batch.

        `gradient` is in the order of an actor's learnable tensors. Other networks and their state stay
        unchanged.
        """
        self.factors.absorb(active)
        moves = torch.from_numpy(active).to(gradient[0].device)
        solution = self._solve(self._parts(gradient))
        for direction, new in zip(self.direction, solution, strict=True):
            averaged = self.momentum * direction + (1 - self.momentum) * new
            direction.copy_(torch.where(moves[:, None, None], averaged, direction))
        curvature = self._curvature(self.direction)
        self.pieces.clear()
        # The largest eta with 1/2 eta^2 d^T F d within the bound.
        longest = (2 * self.bound * self.share**2 / curvature).sqrt()
        size = torch.where(moves, longest.clamp(max=self.lr * self.share), 0)
        changes = [size[:, None, None] * part for part in self.direction]
        with torch.no_grad():
            if self.log_std is not None:
                self.log_std.add_(changes.pop(0))
            for weight, bias, change in zip(self.network.weights, self.network.biases, changes, strict=True):
                weight.add_(change[:, :, :-1])
                bias.add_(change[:, :, -1:])
        return Step(size, 0.5 * size**2 * curvature)

    def _solve(self, gradient: Sequence[Tensor]) -> list[Tensor]:
        first = 0 if self.log_std is None else 1
        own = [part / (DiagonalGaussian.LOG_STD_FISHER + self.damping) for part in gradient[:first]]
        return [*own, *self.factors.solve(gradient[first:])]

    def _curvature(self, direction: list[Tensor]) -> Tensor:
        """Return d^T F d, (P,), with damping."""
        first = 0 if self.log_std is None else 1
        own, layers = direction[:first], direction[first:]
        total = DiagonalGaussian.LOG_STD_FISHER * inner(own, own) if own else 0
        if not self.exact:
            damping = self.damping * inner(own, own) if own else 0
            return total + damping + inner(layers, self.factors.product(layers))
        total = total + self.damping * inner(direction, direction)
        parameters = [layer[:, :, :-1] for layer in layers] + [layer[:, :, -1:] for layer in layers]
        for linear, information, weight in self.pieces:
            change = linear.jvp(parameters)
            total = total + ((change * information(change)).sum(1) * weight).sum(1)
        return total

    def anneal(self, share: float) -> None:
        """Scale steps to `share` of their configured size: the KL bound is multiplied by its square."""
        self.share = share

    def narrow(self, policies: Tensor, network: nn.Module, log_std: nn.Parameter | None) -> Self:
        """Return an optimiser for `network` and `log_std`, copies of networks `policies` (n,)."""
        part = copy(self)
        part.network, part.log_std, part.pieces = _perceptrons(network), log_std, []
        part.factors = self.factors.narrow(policies)
        part.direction = [tensor[policies] for tensor in self.direction]
        return part

    def adopt(self, policies: Tensor, part: Self) -> None:
        """Copy the state of networks `policies` (n,) from `part`, a result of `narrow`."""
        self.factors.adopt(policies, part.factors)
        for mine, theirs in zip(self.direction, part.direction, strict=True):
            mine.index_copy_(0, policies, theirs)

    def state_dict(self) -> dict[str, Any]:
        """Return factors and directions, each with leading axis P."""
        return {"factors": self.factors.state_dict(), "direction": self.direction}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore the result of `state_dict`, by copying."""
        self.factors.load_state_dict(state["factors"])
        for mine, theirs in zip(self.direction, state["direction"], strict=True):
            mine.copy_(theirs)


def _perceptrons(network: nn.Module) -> StackedMLP:
    if not isinstance(network, StackedMLP):
        raise HeadwayError(
            "K-FAC needs multilayer perceptrons: use algo.model.core=none, another algorithm, or algo=custom "
            "with another algo.update than kfac and with algo.critic_update=adam"
        )
    return network
