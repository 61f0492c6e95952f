"""Natural gradient for a stack of critics (Wu et al. 2017, arXiv:1708.05144, section 3.1)."""

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from headway_algos.networks.linearised import LinearisedMLP
from headway_algos.optim.config import KroneckerConfig
from headway_algos.optim.kfac import StackedKFAC


class KFACRegression:
    """Steps of `StackedKFAC` for networks that regress on one number per row.

    The prediction is the mean of a Gaussian with standard deviation 1, so that squared errors are twice its
    negative log-likelihood, and the Fisher information is the Gauss-Newton matrix E[J^T J]. No sampling is
    needed: the scores of samples are z J with z standard normal, and E[z^2] = 1. The KL divergence of a step
    is half the mean squared change of the prediction, in the units of the targets.
    """

    def __init__(self, network: nn.Module, config: KroneckerConfig, lr: float, kl_bound: float) -> None:
        """Raises HeadwayError for networks other than multilayer perceptrons."""
        self.optimiser = StackedKFAC(network, None, config, lr, kl_bound)
        self.network = self.optimiser.network

    def begin(self) -> None:
        """Clear the gradients and start a new batch."""
        self.gradient = [torch.zeros_like(parameter) for parameter in self.network.parameters()]
        self.optimiser.begin()

    def include(
        self, inputs: Tensor, taken: Tensor | None, weight: Tensor, loss: Callable[[Tensor], Tensor]
    ) -> Tensor:
        """Add a piece of the batch; return its losses, (P,).

        The piece consists of inputs (P, B, D), the index `taken` (P, B) of the fitted output (None with one
        output), and weights (P, B) that sum to 1 over the batch. `loss` maps outputs (P, A, B) to losses.
        """
        linear = LinearisedMLP.of(self.network, inputs)
        outputs = linear.outputs.requires_grad_()
        losses = loss(outputs)
        (of_outputs,) = torch.autograd.grad(losses.sum(), outputs)
        outputs.requires_grad_(False)
        for total, part in zip(self.gradient, linear.vjp(of_outputs), strict=True):
            total += part
        fitted = torch.ones_like(outputs)
        if taken is not None:
            fitted = torch.zeros_like(fitted).scatter_(1, taken[:, None], 1)
        self.optimiser.include(linear, fitted, lambda change: fitted * change, weight)
        return losses.detach()

    def step(self, active: NDArray[np.bool_]) -> Tensor:
        """Step the `active` (P,) networks down the gradients of the losses; return gradient norms (P,).

        Active networks are those with rows in the batch.
        """
        self.optimiser.step([-0.5 * gradient for gradient in self.gradient], active)
        return torch.stack([gradient.square().sum((1, 2)) for gradient in self.gradient]).sum(0).sqrt()

    def anneal(self, share: float) -> None:
        """Scale steps to `share` of their configured size."""
        self.optimiser.anneal(share)

    def state_dict(self) -> dict[str, Any]:
        """Return factors and directions."""
        return self.optimiser.state_dict()

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore the result of `state_dict`."""
        self.optimiser.load_state_dict(state)
