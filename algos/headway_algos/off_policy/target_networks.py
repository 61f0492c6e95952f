"""Target networks (Mnih et al. 2015, doi 10.1038/nature14236), temporal-difference targets and losses."""

from copy import deepcopy

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from headway_algos.networks.mlp import StackedMLP


def temporal_difference_target(returns: Tensor, discounts: Tensor, next_values: Tensor) -> Tensor:
    """Return y = G + gamma^k V(o'), (P, b); the discount gamma^k is 0 where the stream terminated."""
    return returns + discounts * next_values


def best_allowed(values: Tensor, masks: Tensor | None) -> Tensor:
    """Return the allowed actions (P, b) of highest value, given values (P, A, b) and masks (P, b, A)."""
    if masks is not None:
        values = values.masked_fill(~masks.transpose(1, 2), -torch.inf)
    return values.argmax(1)


def regression_loss(errors: Tensor, kind: str) -> Tensor:
    """Return half the squared error, or Huber's loss, linear beyond 1 (Huber 1964), elementwise."""
    if kind == "squared":
        return 0.5 * errors**2
    return functional.huber_loss(errors, torch.zeros_like(errors), reduction="none")


class TargetNetwork:
    """A delayed copy of a stack of networks."""

    def __init__(self, online: StackedMLP, every: int, tau: float) -> None:
        self.online, self.every, self.tau = online, every, tau
        self.network = deepcopy(online).requires_grad_(False)

    def follow(self, active: NDArray[np.bool_], counts: NDArray[np.int64]) -> None:
        """Update theta' <- theta' + tau (theta - theta') for `active` networks at every `every`-th step.

        `active` (P,): networks that have just taken a gradient step; `counts` (P,): steps of each so far.
        """
        due = active & (counts % self.every == 0)
        if not due.any():
            return
        with torch.no_grad():
            for target, online in zip(self.network.parameters(), self.online.parameters(), strict=True):
                share = torch.from_numpy(due * self.tau).to(target)
                target.lerp_(online, share.view(-1, *[1] * (target.dim() - 1)).expand_as(target))


def mean_over_batch(losses: Tensor, active: NDArray[np.bool_]) -> Tensor:
    """Return means (P,) of losses (P, b); 0, without gradient, for networks not `active` (P,)."""
    selected: Tensor = torch.from_numpy(active).to(losses.device)
    return torch.where(selected, losses.mean(1), 0)
