"""One Adam over a stack of networks, gradients clipped and steps counted for each network by itself."""

from collections.abc import Iterable
from copy import copy
from typing import Any, Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.optim.adam import adam

BETA_1, BETA_2, EPSILON = 0.9, 0.999, 1e-5


class StackedAdam:
    """Adam (Kingma and Ba, arXiv:1412.6980) works element by element, so one serves every network.

    `grad_clip` bounds the norm of each network's gradient over all its tensors; None: no bound. Moments and
    counts of steps belong to a network: no network's steps depend on its stack, or on when others stepped.
    """

    def __init__(self, parameters: Iterable[nn.Parameter], lr: float, grad_clip: float | None) -> None:
        self.parameters = list(parameters)
        self.grad_clip = grad_clip
        self.base_lr = self.lr = lr
        self.means = [torch.zeros_like(parameter) for parameter in self.parameters]
        self.squares = [torch.zeros_like(parameter) for parameter in self.parameters]
        for parameter, mean in zip(self.parameters, self.means, strict=True):
            if parameter.stride() != mean.stride():
                raise ValueError(f"a parameter of strides {parameter.stride()} has gaps: give a copy of it")
        self.counts = np.zeros(len(self.parameters[0]), np.int64)

    def begin(self) -> None:
        """Forget the gradients."""
        for parameter in self.parameters:
            parameter.grad = None

    def anneal(self, share: float) -> None:
        """Set the learning rate to `share` of its base."""
        self.lr = self.base_lr * share

    def step(self, active: NDArray[np.bool_]) -> Tensor:
        """Clip and apply the gradients; returns each network's norm before the clip, (P,).

        Networks that are not `active` (P,) had no data: they stay as they were, instead of moving on by
        their momentum, and their norm is 0.
        """
        gradients = [_gradient(parameter) for parameter in self.parameters]
        if not active.all():
            for gradient in gradients:
                gradient[torch.from_numpy(~active).to(gradient.device)] = 0
        norm = torch.stack([g.flatten(1).square().sum(1) for g in gradients]).sum(0).sqrt()
        if self.grad_clip is not None:
            factor = (self.grad_clip / (norm + 1e-6)).clamp(max=1)
            for gradient in gradients:
                gradient.mul_(factor.view(-1, *[1] * (gradient.dim() - 1)))
        tensors = [[p.detach() for p in self.parameters], gradients, self.means, self.squares]
        # Adam's correction of its young moments depends on the count: networks of one count go together.
        for count in sorted(set(self.counts[active].tolist())):
            chosen = active & (self.counts == count)
            if chosen.all():
                self._apply(tensors, count)
                continue
            index = torch.from_numpy(np.flatnonzero(chosen)).to(norm.device)
            parts = [[tensor[index] for tensor in kind] for kind in tensors]
            self._apply(parts, count)
            for kind, part in zip(tensors, parts, strict=True):
                for tensor, values in zip(kind, part, strict=True):
                    tensor.index_copy_(0, index, values)
        self.counts[active] += 1
        return norm

    def _apply(self, tensors: list[list[Tensor]], count: int) -> None:
        """torch's Adam on (parameters, gradients, means, squares) that took `count` steps."""
        parameters, gradients, means, squares = tensors
        counts = [torch.full((), float(count), device=parameter.device) for parameter in parameters]
        with torch.no_grad():
            adam(
                parameters, gradients, means, squares, [], counts, fused=True, amsgrad=False, beta1=BETA_1,
                beta2=BETA_2, lr=self.lr, weight_decay=0.0, eps=EPSILON, maximize=False,
            )  # fmt: skip

    def narrow(self, policies: Tensor, parameters: Iterable[nn.Parameter]) -> Self:
        """The same for networks `policies` (n,) alone: `parameters` are copies of theirs."""
        part = copy(self)
        part.parameters = list(parameters)
        part.means = [tensor[policies] for tensor in self.means]
        part.squares = [tensor[policies] for tensor in self.squares]
        part.counts = self.counts[policies.cpu().numpy()]
        return part

    def adopt(self, policies: Tensor, part: Self) -> None:
        """Take over what `part`, narrowed to these policies, has become."""
        for mine, theirs in zip(self.means + self.squares, part.means + part.squares, strict=True):
            mine.index_copy_(0, policies, theirs)
        self.counts[policies.cpu().numpy()] = part.counts

    def state_dict(self) -> dict[str, Any]:
        """Adam's moments and step counts, each with leading axis P."""
        return {"means": self.means, "squares": self.squares, "counts": torch.from_numpy(self.counts)}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Inverse of `state_dict`; a copy, which leaves `state` as it is."""
        for mine, theirs in zip(self.means + self.squares, [*state["means"], *state["squares"]], strict=True):
            mine.copy_(theirs)
        self.counts[:] = state["counts"].cpu().numpy()


def _gradient(parameter: nn.Parameter) -> Tensor:
    """Of a parameter, in its layout: torch's fused Adam pairs elements by their place in memory and takes
    another layout without complaint (its foreach form is safe, and slower)."""
    if parameter.grad is None:
        return torch.zeros_like(parameter)
    if parameter.grad.stride() == parameter.stride():
        return parameter.grad
    return torch.empty_like(parameter).copy_(parameter.grad)
