"""One Adam over a stack of networks, with gradients clipped for each network by itself."""

from collections.abc import Iterable
from typing import Any

import torch
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

    def step(self) -> Tensor:
        """Clip and apply the gradients; returns each network's norm before the clip, (P,)."""
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
        """Inverse of `state_dict`."""
        self.adam.load_state_dict(state)
