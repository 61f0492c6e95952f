"""Target networks (Mnih et al. 2015) and what they say returns should have been."""

from copy import deepcopy
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from headway_algos.networks.mlp import StackedMLP


def temporal_difference_target(returns: Tensor, discounts: Tensor, next_values: Tensor) -> Tensor:
    """y = G + gamma^k V(o'), (P, b), whose second part is nothing where the stream terminated."""
    return returns + discounts * next_values


def best_allowed(values: Tensor, masks: Tensor | None) -> Tensor:
    """argmax over the allowed actions: (P, b) from values (P, A, b) and masks (P, b, A)."""
    if masks is not None:
        values = values.masked_fill(~masks.transpose(1, 2), -torch.inf)
    return values.argmax(1)


def regression_loss(errors: Tensor, kind: str) -> Tensor:
    """Half the squared error, or Huber's loss, linear beyond 1 (Huber 1964): as `errors`."""
    if kind == "squared":
        return 0.5 * errors**2
    return functional.huber_loss(errors, torch.zeros_like(errors), reduction="none")


class TargetNetwork:
    """A copy of a stack of networks that follows it slowly."""

    def __init__(self, online: StackedMLP, every: int, tau: float) -> None:
        self.online, self.every, self.tau = online, every, tau
        self.network = deepcopy(online).requires_grad_(False)

    def follow(self, active: NDArray[np.bool_], counts: NDArray[np.int64]) -> None:
        """theta' <- theta' + tau (theta - theta') of networks that have just taken a step (`active`, (P,)) if
        that was their `every`-th; `counts` (P,) are the steps of each so far."""
        due = active & (counts % self.every == 0)
        if not due.any():
            return
        with torch.no_grad():
            for mine, theirs in zip(self.network.parameters(), self.online.parameters(), strict=True):
                share = torch.from_numpy(due * self.tau).to(mine)
                mine.lerp_(theirs, share.view(-1, *[1] * (mine.dim() - 1)).expand_as(mine))

    def state_dict(self) -> dict[str, Any]:
        """The copy's tensors."""
        return self.network.state_dict()

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Inverse of `state_dict`; raises RuntimeError where shapes differ."""
        self.network.load_state_dict(state)


def mean_over_batch(losses: Tensor, active: NDArray[np.bool_]) -> Tensor:
    """(P, b) -> (P,): 0, without gradient, for networks that are not `active` (P,)."""
    here: Tensor = torch.from_numpy(active).to(losses.device)
    return torch.where(here, losses.mean(1), 0)
