"""All that policies learn from, at once: the selected rows of an iteration, side by side."""

from collections.abc import Iterator
from dataclasses import dataclass, fields, replace
from typing import Any, Self

import numpy as np
import torch
from torch import Tensor

from headway_algos.experience import even_slices
from headway_algos.policy_rows import PolicyRows


@dataclass(frozen=True)
class WholeBatch:
    """Every policy's selected rows in their order, then padding up to W, the most that one of them has."""

    observations: Tensor
    """(P, W, D), normalised."""
    masks: Tensor | None
    """(P, W, A)"""
    actions: Tensor
    """(P, W) or (P, W, A)"""
    log_probs: Tensor
    """(P, W), at the parameters that acted."""
    advantages: Tensor
    """(P, W)"""
    weight: Tensor
    """(P, W): 1 / (selected rows of the policy), 0 in padding."""
    places: Tensor
    """(P, W): which of the B rows it is."""

    @classmethod
    def of(cls, rows: PolicyRows, advantages: Tensor) -> Self:
        """From rows and their advantages (P, B). Padding repeats a selected row of the same policy, if it
        has any."""
        counts = rows.selected.sum(axis=1, keepdims=True)
        column = np.arange(counts.max())
        order = np.argsort(~rows.selected, axis=1, kind="stable")[:, : len(column)]
        order = np.where(column < counts, order, order[:, :1])
        weight = np.where(column < counts, 1 / np.maximum(counts, 1), 0)
        places = torch.from_numpy(order).to(advantages.device)
        stack = torch.arange(len(order), device=advantages.device)[:, None]
        return cls(
            rows.observations[stack, places],
            None if rows.masks is None else rows.masks[stack, places],
            rows.actions[stack, places],
            rows.log_probs[stack, places],
            advantages[stack, places],
            torch.from_numpy(weight).to(advantages),
            places,
        )

    @property
    def has_rows(self) -> Tensor:
        """(P,): the policy has a row to learn from."""
        return (self.weight > 0).any(1)

    def _each(self, rows: slice | Tensor, policies: slice | Tensor) -> Self:
        tensors: dict[str, Any] = {field.name: getattr(self, field.name) for field in fields(self)}
        present = {name: tensor for name, tensor in tensors.items() if tensor is not None}
        return replace(self, **{name: tensor[policies][:, rows] for name, tensor in present.items()})

    def narrow(self, policies: Tensor) -> Self:
        """That of policies (n,) alone."""
        return self._each(slice(None), policies)

    def pieces(self, piece_samples: int) -> Iterator[Self]:
        """Cuts along W that stay in the cache, in order: weights are those of the whole."""
        for rows in even_slices(self.weight.shape[1], len(self.weight), piece_samples):
            yield self._each(rows, slice(None))

    def strided(self, every: int) -> Self:
        """Every policy's rows 0, `every`, 2 `every` ..., with weights that again sum to 1."""
        if every == 1:
            return self
        part = self._each(slice(None, None, every), slice(None))
        smallest = torch.finfo(part.weight.dtype).tiny
        return replace(part, weight=part.weight / part.weight.sum(1, keepdim=True).clamp(min=smallest))
