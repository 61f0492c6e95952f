"""One Adam over a stack of networks, with gradients clipped for each network by itself."""

from collections.abc import Iterable
from copy import deepcopy
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn


class StackedAdam:
    """Adam (Kingma and Ba, arXiv:1412.6980) works element by element, so one serves every network.

    `grad_clip` bounds the norm of each network's gradient over all its tensors; None: no bound.
    """

    def __init__(self, parameters: Iterable[nn.Parameter], lr: float, grad_clip: float | None) -> None:
        self.parameters = list(parameters)
        self.grad_clip = grad_clip
        self.base_lr = lr
        self.adam = torch.optim.Adam(self.parameters, lr=lr, eps=1e-5, fused=True)

    def begin(self) -> None:
        """Forget the gradients."""
        self.adam.zero_grad(set_to_none=True)

    def anneal(self, share: float) -> None:
        """Set the learning rate to `share` of its base."""
        for group in self.adam.param_groups:
            group["lr"] = self.base_lr * share

    def step(self, active: NDArray[np.bool_]) -> Tensor:
        """Clip and apply the gradients; returns each network's norm before the clip, (P,).

        Networks that are not `active` (P,) had no data: they stay as they were, instead of moving on by
        their momentum. Adam counts the step for all, so that no network's steps depend on its stack.
        """
        if active.all():
            return self._step()
        idle = torch.from_numpy(~active).to(self.parameters[0].device)
        kept = [tensor[idle] for tensor in self._tensors()]
        for parameter in self.parameters:
            parameter.grad = torch.zeros_like(parameter) if parameter.grad is None else parameter.grad
            parameter.grad[idle] = 0
        norm = self._step()
        with torch.no_grad():
            for tensor, values in zip(self._tensors(), kept, strict=False):
                tensor[idle] = values
        return norm

    def _tensors(self) -> list[Tensor]:
        """Parameters, then Adam's moments once there are any: before, idle networks' stay at their 0."""
        states = [self.adam.state[parameter] for parameter in self.parameters]
        moments = [state[name] for state in states if state for name in ("exp_avg", "exp_avg_sq")]
        return [*(parameter.detach() for parameter in self.parameters), *moments]

    def _step(self) -> Tensor:
        gradients = [parameter.grad for parameter in self.parameters if parameter.grad is not None]
        norm = torch.stack([g.flatten(1).square().sum(1) for g in gradients]).sum(0).sqrt()
        if self.grad_clip is not None:
            factor = (self.grad_clip / (norm + 1e-6)).clamp(max=1)
            for gradient in gradients:
                gradient.mul_(factor.view(-1, *[1] * (gradient.dim() - 1)))
        self.adam.step()
        return norm

    def state_dict(self) -> dict[str, Any]:
        """Adam's moments and step counts."""
        return self.adam.state_dict()

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Inverse of `state_dict`; a copy, since torch would go on to write into `state`."""
        self.adam.load_state_dict(deepcopy(state))
