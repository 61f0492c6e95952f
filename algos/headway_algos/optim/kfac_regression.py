"""A critic's natural gradient (Wu et al. 2017, arXiv:1708.05144, section 3.1), for a stack of networks."""

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from headway_algos.config import AlgoConfig
from headway_algos.networks.linearised import LinearisedMLP
from headway_algos.optim.kfac import StackedKFAC


class KFACRegression:
    """Steps of `StackedKFAC` for networks that regress on one number a row.

    What is learned is seen as the mean of a Gaussian of standard deviation 1, so that squared errors are
    twice its negative log-likelihood, and the Fisher information is the Gauss-Newton matrix E[J^T J]. With
    one number a row nothing has to be drawn: the scores of draws are z J with z standard normal, and the mean
    of z^2 is 1. A step's divergence is half the mean squared change of that number, in the units of learning.
    """

    def __init__(self, network: nn.Module, config: AlgoConfig) -> None:
        """Raises HeadwayError for networks other than multilayer perceptrons."""
        lr = config.critic_lr or config.lr
        self.optimiser = StackedKFAC(network, None, config, lr, config.critic_kl_bound)
        self.network = self.optimiser.network

    def begin(self) -> None:
        """Forget the gradients, and begin a new batch."""
        for parameter in self.network.parameters():
            parameter.grad = None
        self.optimiser.begin()

    def include(self, inputs: Tensor, taken: Tensor | None, weight: Tensor) -> None:
        """Add a piece of the batch: inputs (P, B, D), which output is fitted (P, B) if there are several, and
        weights (P, B) that sum to 1 over the batch."""
        linear = LinearisedMLP.of(self.network, inputs)
        meant = torch.ones_like(linear.outputs)
        if taken is not None:
            meant = torch.zeros_like(meant).scatter_(1, taken[:, None], 1)
        self.optimiser.include(linear, meant, lambda change: meant * change, weight)

    def step(self, active: NDArray[np.bool_]) -> Tensor:
        """Step the networks that have rows in the batch, (P,), down the gradients of squared errors.

        Returns the norms of the gradients (P,).
        """
        parameters = list(self.network.parameters())
        gradients = [torch.zeros_like(p) if p.grad is None else p.grad for p in parameters]
        self.optimiser.step([-0.5 * gradient for gradient in gradients], active)
        return torch.stack([gradient.square().sum((1, 2)) for gradient in gradients]).sum(0).sqrt()

    def anneal(self, share: float) -> None:
        """Take steps of `share` of their length from now on."""
        self.optimiser.anneal(share)

    def state_dict(self) -> dict[str, Any]:
        """Factors and directions."""
        return self.optimiser.state_dict()

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Inverse of `state_dict`."""
        self.optimiser.load_state_dict(state)
