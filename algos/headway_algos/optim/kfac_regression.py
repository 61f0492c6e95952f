"""Natural gradient for a stack of critics (Wu et al. 2017, arXiv:1708.05144, section 3.1)."""

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from headway_algos.config import AlgoConfig
from headway_algos.networks.linearised import LinearisedMLP
from headway_algos.optim.kfac import StackedKFAC


class KFACRegression:
    """Steps of `StackedKFAC` for networks that regress on one number per row.

    The prediction is the mean of a Gaussian with standard deviation 1, so that squared errors are twice its
    negative log-likelihood, and the Fisher information is the Gauss-Newton matrix E[J^T J]. No sampling is
    needed: the scores of samples are z J with z standard normal, and E[z^2] = 1. The KL divergence of a step
    is half the mean squared change of the prediction, in the units of the targets.
    """

    def __init__(self, network: nn.Module, config: AlgoConfig) -> None:
        """Raises HeadwayError for networks other than multilayer perceptrons."""
        lr = config.critic_lr or config.lr
        self.optimiser = StackedKFAC(network, None, config, lr, config.critic_kl_bound)
        self.network = self.optimiser.network

    def begin(self) -> None:
        """Clear the gradients and start a new batch."""
        for parameter in self.network.parameters():
            parameter.grad = None
        self.optimiser.begin()

    def include(self, linear: LinearisedMLP, taken: Tensor | None, weight: Tensor) -> None:
        """Add a piece of the batch: the linearised networks, and weights (P, B) that sum to 1 over the batch.

        `taken` (P, B) selects the output that is trained, for networks with several outputs.
        """
        selected = torch.ones_like(linear.outputs)
        if taken is not None:
            selected = torch.zeros_like(selected).scatter_(1, taken[:, None], 1)
        self.optimiser.include(linear, selected, lambda change: selected * change, weight)

    def step(self, active: NDArray[np.bool_]) -> None:
        """Take a descent step of the `active` (P,) networks, those with rows in the batch."""
        parameters = list(self.network.parameters())
        gradients = [torch.zeros_like(p) if p.grad is None else p.grad for p in parameters]
        self.optimiser.step([-0.5 * gradient for gradient in gradients], active)

    def anneal(self, share: float) -> None:
        """Scale steps to `share` of their configured size."""
        self.optimiser.anneal(share)

    def state_dict(self) -> dict[str, Any]:
        """Return factors and directions."""
        return self.optimiser.state_dict()

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore the result of `state_dict`."""
        self.optimiser.load_state_dict(state)
