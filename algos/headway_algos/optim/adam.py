"""Adam for a stack of networks, with gradient clipping and step counts per network."""

from collections.abc import Iterable, Sequence
from copy import copy
from dataclasses import dataclass
from itertools import accumulate
from math import inf
from typing import Any, Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.optim.adam import adam

from headway_algos.kernels.adam import Adam, step_networks

BETA_1, BETA_2, EPSILON = 0.9, 0.999, 1e-5


class StackedAdam:
    """Adam (Kingma and Ba 2015, arXiv:1412.6980) for all networks of a stack.

    `grad_clip` bounds the norm of each network's gradient over all its tensors; None: no bound. Moments and
    step counts are per network, so a network's steps do not depend on the rest of the stack. The parameters
    become views of one tensor, so that a step takes a few operations whatever their number.
    """

    def __init__(self, parameters: Iterable[nn.Parameter], lr: float, grad_clip: float | None) -> None:
        self.grad_clip = grad_clip
        self.base_lr = self.lr = lr
        self._hold(list(parameters))
        self.counts = np.zeros(len(self.values.whole), np.int64)

    def _hold(self, parameters: list[nn.Parameter]) -> None:
        self.parameters = parameters
        self.values, self.gradient, self.means, self.squares = (Blocks.like(parameters) for _ in range(4))
        for parameter, part in zip(parameters, self.values.parts, strict=True):
            part.copy_(parameter.detach())
            parameter.data = part
        self._begins = [part.data_ptr() for part in self.values.parts]
        blocks = (self.values, self.gradient, self.means, self.squares)
        self._arrays = [] if self.values.whole.is_cuda else [block.whole.numpy() for block in blocks]

    def begin(self) -> None:
        """Clear the gradients, both of the parameters and in `gradient`."""
        self.gradient.whole.zero_()
        for parameter in self.parameters:
            parameter.grad = None

    def anneal(self, share: float) -> None:
        """Set the learning rate to `share` of its configured value."""
        self.lr = self.base_lr * share

    def step(self, active: NDArray[np.bool_]) -> Tensor:
        """Clip and apply the gradients since `begin`; return the gradient norms before clipping, (P,).

        Networks not `active` (P,) had no data: even momentum leaves them unchanged, and their norm is 0.
        Raises RuntimeError if a parameter's storage has been replaced.
        """
        self._collect()
        return (self._step_by_torch if self.values.whole.is_cuda else self._step_compiled)(active)

    def _step_by_torch(self, active: NDArray[np.bool_]) -> Tensor:
        gradient = self.gradient.whole
        if not active.all():
            gradient[torch.from_numpy(~active).to(gradient.device)] = 0
        norm: Tensor = torch.linalg.vector_norm(gradient, dim=1)
        if self.grad_clip is not None:
            gradient *= (self.grad_clip / (norm + 1e-6)).clamp_(max=1)[:, None]
        tensors = [self.values.whole, gradient, self.means.whole, self.squares.whole]
        # Adam's bias correction depends on the count: networks with equal counts are updated together.
        for count in sorted(set(self.counts[active].tolist())):
            chosen = active & (self.counts == count)
            if chosen.all():
                _apply(tensors, count, self.lr)
                continue
            index = torch.from_numpy(np.flatnonzero(chosen)).to(norm.device)
            parts = [tensor[index] for tensor in tensors]
            _apply(parts, count, self.lr)
            for tensor, part in zip(tensors, parts, strict=True):
                tensor.index_copy_(0, index, part)
        self.counts[active] += 1
        return norm

    def _step_compiled(self, active: NDArray[np.bool_]) -> Tensor:
        values, gradient, _, _ = self._arrays
        norms = np.empty(len(active), values.dtype)
        step_networks(values, gradient, self.kernel_state(), active, norms)
        return torch.from_numpy(norms)

    def kernel_state(self) -> Adam:
        """Return state and settings for kernels, which change the state in place."""
        bound = inf if self.grad_clip is None else float(self.grad_clip)
        _, _, means, squares = self._arrays
        return Adam(means, squares, self.counts, float(self.lr), bound, (BETA_1, BETA_2), EPSILON)

    def starts(self, parameters: Iterable[nn.Parameter]) -> list[int]:
        """Return the offset of each parameter among the values of its network.

        Raises RuntimeError if a parameter's storage has been replaced.
        """
        known = {id(parameter): place for place, parameter in enumerate(self.parameters)}
        whole = self.values.whole
        return [
            (self._found(known[id(parameter)]) - whole.data_ptr()) // whole.element_size()
            for parameter in parameters
        ]

    def _found(self, place: int) -> int:
        """Return the address of a parameter's values; raise RuntimeError if it has changed."""
        begins = self._begins[place]
        if self.parameters[place].data_ptr() != begins:
            raise RuntimeError(
                "a parameter was moved, or given to another optimiser, after this one was made"
            )
        return begins

    def _collect(self) -> None:
        """Copy the parameters' gradients, if any, into `gradient`."""
        for place, gradient in enumerate(self.gradient.parts):
            self._found(place)
            if (found := self.parameters[place].grad) is not None:
                gradient.copy_(found)

    def narrow(self, policies: Tensor, parameters: Iterable[nn.Parameter]) -> Self:
        """Return an optimiser for `parameters`, copies of those of networks `policies` (n,)."""
        part = copy(self)
        part._hold(list(parameters))
        part.means.whole.copy_(self.means.whole[policies])
        part.squares.whole.copy_(self.squares.whole[policies])
        part.counts = self.counts[policies.cpu().numpy()]
        return part

    def adopt(self, policies: Tensor, part: Self) -> None:
        """Copy the state of networks `policies` (n,) from `part`, a result of `narrow`."""
        self.means.whole.index_copy_(0, policies, part.means.whole)
        self.squares.whole.index_copy_(0, policies, part.squares.whole)
        self.counts[policies.cpu().numpy()] = part.counts

    def state_dict(self) -> dict[str, Any]:
        """Return Adam's moments, in the shapes of the parameters, and step counts, with leading axis P."""
        counts = torch.from_numpy(self.counts)
        return {"means": self.means.parts, "squares": self.squares.parts, "counts": counts}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore the result of `state_dict`, by copying."""
        moments = self.means.parts + self.squares.parts
        for part, stored in zip(moments, [*state["means"], *state["squares"]], strict=True):
            part.copy_(stored)
        self.counts[:] = state["counts"].cpu().numpy()


@dataclass(frozen=True)
class Blocks:
    """Tensors (P, ...) stored as views of one tensor (P, V)."""

    whole: Tensor
    """(P, V)"""
    parts: list[Tensor]
    """(P, ...) each: views of `whole`."""

    @classmethod
    def like(cls, tensors: Sequence[Tensor]) -> Self:
        """Return zeros in the shapes of `tensors`."""
        sizes = [tensor[0].numel() for tensor in tensors]
        starts = [0, *accumulate(sizes)]
        whole = tensors[0].detach().new_zeros(len(tensors[0]), starts[-1])
        places = zip(tensors, starts, sizes, strict=False)
        return cls(whole, [whole[:, at : at + size].view(tensor.shape) for tensor, at, size in places])


def _apply(tensors: Sequence[Tensor], count: int, lr: float) -> None:
    """Apply a step of torch's Adam to (values, gradient, means, squares), after `count` steps so far."""
    values, gradient, means, squares = ([tensor] for tensor in tensors)
    counts = [torch.full((), float(count), device=gradient[0].device)]
    with torch.no_grad():
        adam(
            values, gradient, means, squares, [], counts, fused=True, amsgrad=False, beta1=BETA_1,
            beta2=BETA_2, lr=lr, weight_decay=0.0, eps=EPSILON, maximize=False,
        )  # fmt: skip
