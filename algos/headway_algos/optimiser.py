"""One Adam over a stack of networks, gradients clipped and steps counted for each network by itself."""

from collections.abc import Iterable, Sequence
from copy import copy
from typing import Any, Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.optim.adam import adam

BETA_1, BETA_2, EPSILON = 0.9, 0.999, 1e-5
LANES = 16
"""Numbers that a processor works on at once, at most. torch's Adam rounds what is left over otherwise: with
whole lanes alone a network steps the same in any stack, bit for bit."""


class StackedAdam:
    """Adam (Kingma and Ba, arXiv:1412.6980) works element by element, so one serves every network.

    `grad_clip` bounds the norm of each network's gradient over all its tensors; None: no bound. Moments and
    counts of steps belong to a network: no network's steps depend on its stack, or on when others stepped.
    The parameters become views of one tensor: a step is then a handful of operations, however many there are.
    """

    def __init__(self, parameters: Iterable[nn.Parameter], lr: float, grad_clip: float | None) -> None:
        self.parameters = list(parameters)
        self.grad_clip = grad_clip
        self.base_lr = self.lr = lr
        self.values = joined(self.parameters)
        """(P, V): all parameters of a network, one after another, each filled up with 0 to whole LANES; as in
        the next two."""
        self.means, self.squares = torch.zeros_like(self.values), torch.zeros_like(self.values)
        self.counts = np.zeros(len(self.values), np.int64)

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
        their momentum, and their norm is 0. Raises RuntimeError where the parameters are others by now.
        """
        if self.parameters[0].data_ptr() != self.values.data_ptr():
            raise RuntimeError(
                "the parameters were moved, or given to another optimiser, since this one began"
            )
        gradient = self._gradient()
        if not active.all():
            gradient[torch.from_numpy(~active).to(gradient.device)] = 0
        norm: Tensor = torch.linalg.vector_norm(gradient, dim=1)
        if self.grad_clip is not None:
            gradient *= (self.grad_clip / (norm + 1e-6)).clamp_(max=1)[:, None]
        tensors = [self.values, gradient, self.means, self.squares]
        # Adam's correction of its young moments depends on the count: networks of one count go together.
        for count in sorted(set(self.counts[active].tolist())):
            chosen = active & (self.counts == count)
            if chosen.all():
                self._apply(tensors, count)
                continue
            index = torch.from_numpy(np.flatnonzero(chosen)).to(norm.device)
            parts = [tensor[index] for tensor in tensors]
            self._apply(parts, count)
            for tensor, part in zip(tensors, parts, strict=True):
                tensor.index_copy_(0, index, part)
        self.counts[active] += 1
        return norm

    def _gradient(self) -> Tensor:
        """(P, V), 0 where there is none."""
        parts: list[Tensor] = []
        for parameter in self.parameters:
            gradient = torch.zeros_like(parameter) if parameter.grad is None else parameter.grad
            parts.append(gradient.flatten(1))
            if filler := -parts[-1].shape[1] % LANES:
                parts.append(gradient.new_zeros(len(gradient), filler))
        return torch.cat(parts, dim=1)

    def _apply(self, tensors: list[Tensor], count: int) -> None:
        """torch's Adam on (values, gradient, means, squares) that took `count` steps."""
        values, gradient, mean, square = ([tensor] for tensor in tensors)
        counts = [torch.full((), float(count), device=gradient[0].device)]
        with torch.no_grad():
            adam(
                values, gradient, mean, square, [], counts, fused=True, amsgrad=False, beta1=BETA_1,
                beta2=BETA_2, lr=self.lr, weight_decay=0.0, eps=EPSILON, maximize=False,
            )  # fmt: skip

    def narrow(self, policies: Tensor, parameters: Iterable[nn.Parameter]) -> Self:
        """The same for networks `policies` (n,) alone: `parameters` are copies of theirs."""
        part = copy(self)
        part.parameters = list(parameters)
        part.values = joined(part.parameters)
        part.means, part.squares = self.means[policies], self.squares[policies]
        part.counts = self.counts[policies.cpu().numpy()]
        return part

    def adopt(self, policies: Tensor, part: Self) -> None:
        """Take over what `part`, narrowed to these policies, has become."""
        self.means.index_copy_(0, policies, part.means)
        self.squares.index_copy_(0, policies, part.squares)
        self.counts[policies.cpu().numpy()] = part.counts

    def state_dict(self) -> dict[str, Any]:
        """Adam's moments and step counts, each with leading axis P."""
        return {"means": self.means, "squares": self.squares, "counts": torch.from_numpy(self.counts)}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Inverse of `state_dict`; a copy, which leaves `state` as it is."""
        self.means.copy_(state["means"])
        self.squares.copy_(state["squares"])
        self.counts[:] = state["counts"].cpu().numpy()


def joined(parameters: Sequence[nn.Parameter]) -> Tensor:
    """(P, V): parameters (P, ...) one after another, each filled up with 0 to whole LANES; from now on they
    are views of it."""
    sizes = [parameter[0].numel() for parameter in parameters]
    ends = np.cumsum([-(-size // LANES) * LANES for size in sizes]).tolist()
    values = parameters[0].new_zeros(len(parameters[0]), ends[-1], requires_grad=False)
    for parameter, start, size in zip(parameters, [0, *ends], sizes, strict=False):
        part = values[:, start : start + size]
        part.copy_(parameter.detach().flatten(1))
        parameter.data = part.view(parameter.shape)
    return values


def add_gradients(parameters: Iterable[nn.Parameter], gradients: Iterable[Tensor]) -> None:
    """Add to the parameters' gradients, as backpropagation does."""
    for parameter, gradient in zip(parameters, gradients, strict=True):
        parameter.grad = gradient if parameter.grad is None else parameter.grad.add_(gradient)
