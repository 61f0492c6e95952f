"""The whole batch of an iteration: each policy's selected rows, for updates that take one step on all."""

from collections.abc import Iterator
from dataclasses import dataclass, fields, replace
from typing import Any, Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from headway_algos.batches.minibatches import Piece, even_slices
from headway_algos.batches.policy_batch import PolicyBatch
from headway_algos.networks.timeline import Timeline


@dataclass(frozen=True)
class WholeBatch:
    """Each policy's selected rows in order, padded to W, the largest number of selected rows of a policy.

    For recurrent policies W = L x U: U whole sequences of L steps that contain selected rows, step-major.
    """

    observations: Tensor
    """(P, W, D), normalised."""
    masks: Tensor | None
    """(P, W, A) action masks"""
    actions: Tensor
    """(P, W) for Discrete, (P, W, choices) for MultiDiscrete, (P, W, A) for Box"""
    log_probs: Tensor
    """(P, W), under the parameters that sampled the actions."""
    advantages: Tensor
    """(P, W)"""
    weight: Tensor
    """(P, W): 1 / (selected rows of the policy), 0 for padding."""
    row_index: Tensor
    """(P, W): index of the row among the policy's B rows."""
    timeline: Timeline | None = None
    """Order of the rows in time, for recurrent policies."""
    length: int = 1
    """L: steps per sequence, 1 without recurrence."""
    outputs: Tensor | None = None
    """(P, W, A): network outputs under the parameters that sampled the actions, once computed."""

    @classmethod
    def of(cls, rows: PolicyBatch, advantages: Tensor) -> Self:
        """Build the batch from rows and their advantages (P, B).

        Padding repeats a selected row of the same policy, if it has any.
        """
        if rows.sequences is not None:
            return cls._of_sequences(rows, advantages)
        order, weight = _in_front(rows.selected)
        row_index = torch.from_numpy(order).to(advantages.device)
        stack = torch.arange(len(order), device=advantages.device)[:, None]
        return cls(
            rows.observations[stack, row_index],
            None if rows.masks is None else rows.masks[stack, row_index],
            rows.actions[stack, row_index],
            rows.log_probs[stack, row_index],
            advantages[stack, row_index],
            torch.from_numpy(weight).to(advantages),
            row_index,
        )

    @classmethod
    def _of_sequences(cls, rows: PolicyBatch, advantages: Tensor) -> Self:
        assert rows.sequences is not None
        order, weight = _in_front(rows.sequences.holding(rows.selected))
        network = np.arange(len(order))[:, None]
        chosen = Piece(
            torch.from_numpy(order + network * len(rows.sequences)).to(advantages.device),
            torch.from_numpy(weight).to(advantages),
        )
        selected = torch.from_numpy(rows.selected).to(advantages.device)
        (piece,) = rows.sequences.pieces([chosen], selected)
        offset = torch.from_numpy(network).to(advantages.device) * advantages.shape[1]
        return cls(
            piece.of(rows.observations),
            None if rows.masks is None else piece.of(rows.masks),
            piece.of(rows.actions),
            piece.of(rows.log_probs),
            piece.of(advantages),
            piece.weight,
            piece.index - offset,
            piece.timeline,
            rows.sequences.length,
        )

    @property
    def has_rows(self) -> Tensor:
        """(P,): True for policies with at least one selected row."""
        return (self.weight > 0).any(1)

    def where_rows(self, values: Tensor) -> Tensor:
        """Return values (P,), NaN for policies without a selected row."""
        return torch.where(self.has_rows, values, torch.nan)

    @property
    def _count(self) -> int:
        """Rows, or sequences (U), per policy."""
        return self.weight.shape[1] // self.length

    def _each(self, which: slice, policies: slice | Tensor) -> Self:
        """Return the rows, or sequences, `which` of `policies`."""
        named = {field.name: getattr(self, field.name) for field in fields(self)}
        tensors: dict[str, Any] = {name: value for name, value in named.items() if isinstance(value, Tensor)}
        if self.timeline is None:
            return replace(self, **{name: tensor[policies][:, which] for name, tensor in tensors.items()})

        def cut(tensor: Tensor) -> Tensor:
            chosen = tensor[policies]
            by_step = chosen.view(len(chosen), self.length, self._count, *chosen.shape[2:])
            return by_step[:, :, which].flatten(1, 2)

        parts: dict[str, Any] = {name: cut(tensor) for name, tensor in tensors.items()}
        return replace(self, **parts, timeline=self.timeline.part(which, policies))

    def with_outputs(self, parts: list[Tensor]) -> Self:
        """Return this batch with `outputs` joined from the outputs (P, rows, A) of its pieces, in order."""
        if not parts:
            return replace(self, outputs=self.observations[..., :0])
        by_step = [part.reshape(len(part), self.length, -1, part.shape[2]) for part in parts]
        return replace(self, outputs=torch.cat(by_step, dim=2).flatten(1, 2))

    def narrow(self, policies: Tensor) -> Self:
        """Return the batch of `policies` (n,)."""
        return self._each(slice(None), policies)

    def pieces(self, piece_samples: int) -> Iterator[Self]:
        """Yield parts along W (or U) that fit the cache, in order, with the weights of the whole batch."""
        for part in even_slices(self._count, len(self.weight), max(piece_samples // self.length, 1)):
            yield self._each(part, slice(None))

    def strided(self, every: int) -> Self:
        """Return rows (or sequences) 0, `every`, 2 `every` ... of each policy, with weights that sum to 1."""
        if every == 1:
            return self
        part = self._each(slice(None, None, every), slice(None))
        smallest = torch.finfo(part.weight.dtype).tiny
        return replace(part, weight=part.weight / part.weight.sum(1, keepdim=True).clamp(min=smallest))


def _in_front(selected: NDArray[np.bool_]) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return the indices (P, W) of selected entries (P, B), in order, and weights (P, W), 0 for padding."""
    counts = selected.sum(axis=1, keepdims=True)
    column = np.arange(counts.max())
    order = np.argsort(~selected, axis=1, kind="stable")[:, : len(column)]
    order = np.where(column < counts, order, order[:, :1])
    return order, np.where(column < counts, 1 / np.maximum(counts, 1), 0)
