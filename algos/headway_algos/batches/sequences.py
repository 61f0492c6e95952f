"""Rows of a trajectory as short sequences, for training recurrent networks.

A sequence starts from the hidden state recorded before its first step. That state is exact in the first pass
and later stale by the updates of this iteration only; the stored states of R2D2 (Kapturowski et al. 2019,
"Recurrent Experience Replay in Distributed Reinforcement Learning", section 3) come from a replay buffer and
are far staler. Gradients stop at a sequence's first step (truncated backpropagation through time). Hidden
states are reset where a stream begins within a sequence.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from headway_algos.batches.layout import Layout
from headway_algos.batches.minibatches import Piece, even_slices
from headway_algos.networks.timeline import Timeline


@dataclass(frozen=True)
class Sequences:
    """S sequences of L steps per network, over its B rows, for P networks."""

    row_index: Tensor
    """(L, S): row of each step, the same for all networks."""
    filled: Tensor
    """(L, S) bool: False past the trajectory's end."""
    hidden: Tensor
    """(P, S, M): hidden states before the first step."""
    continues: Tensor
    """(P, B): 0 where a stream begins, else 1."""
    keeps: Tensor | None
    """(P, B) bool: the row updates the hidden state; None: every row does."""

    @classmethod
    def of(
        cls,
        layout: Layout,
        length: int,
        starts: NDArray[Any],
        begins: NDArray[np.bool_],
        keeps: NDArray[np.bool_],
    ) -> Self:
        """Cut a trajectory at multiples of `length`, with hidden states `starts` (ceil(T / length), C, W, M).

        `begins` and `keeps` (T, C, W): see `HiddenStates`. The last sequence is padded if T is not a multiple
        of `length`.
        """
        steps, copies, _ = begins.shape
        each = copies // layout.replicas
        step = np.arange(length)[:, None] + length * np.arange(len(starts))  # (L, chunks)
        agents, within = np.arange(layout.grouping.width), np.arange(each)
        row = np.minimum(step, steps - 1)[:, None, :, None] * each + within
        row = row + (agents * steps * each)[:, None, None]
        filled = np.broadcast_to((step < steps)[:, None, :, None], row.shape).copy()
        hidden = layout.rows(starts).to(layout.dtype)
        return cls(
            torch.from_numpy(row.reshape(length, -1)).to(layout.device),
            torch.from_numpy(filled.reshape(length, -1)).to(layout.device),
            hidden,
            (~layout.rows(begins)).to(layout.dtype),
            None if keeps.all() else layout.rows(keeps),
        )

    def __len__(self) -> int:
        """S: sequences per network."""
        return self.row_index.shape[1]

    @property
    def length(self) -> int:
        """L: steps per sequence."""
        return len(self.row_index)

    def narrow(self, policies: Tensor) -> Self:
        """Return the sequences of networks `policies` (n,)."""
        return replace(
            self,
            hidden=self.hidden[policies],
            continues=self.continues[policies],
            keeps=None if self.keeps is None else self.keeps[policies],
        )

    def holding(self, selected: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Return a mask (P, S) of sequences that contain a selected row (P, B)."""
        held: NDArray[np.bool_] = (selected[:, self.row_index.cpu().numpy()] & self.filled.cpu().numpy()).any(
            axis=1
        )
        return held

    def pieces(self, of_sequences: Sequence[Piece], selected: Tensor) -> list[Piece]:
        """Convert pieces of sequences to pieces of rows.

        Selected rows (P, B) have equal weights that sum to 1 per network; other rows, needed for the hidden
        states only, have weight 0.
        """
        stack, rows = self.continues.shape
        network = torch.arange(stack, device=self.row_index.device)[:, None]
        found: list[Piece] = []
        for piece in of_sequences:
            sequence = piece.index - network * len(self)
            index = self.row_index[:, sequence].transpose(0, 1) + (network * rows)[..., None]
            counts = self.filled[:, sequence].transpose(0, 1) & (piece.weight > 0)[:, None]
            flat = index.flatten()
            weight = (counts.flatten(1) & selected.flatten()[flat].view(stack, -1)).to(self.continues)
            timeline = Timeline(
                self.hidden.flatten(0, 1)[piece.index].transpose(1, 2),
                self.continues.flatten()[flat].view(stack, 1, -1),
                None if self.keeps is None else self.keeps.flatten()[flat].view(stack, 1, -1),
            )
            found.append(Piece(flat.view(stack, -1), weight, timeline))
        total = sum((piece.weight.sum(1, keepdim=True) for piece in found), torch.zeros(()))
        return [replace(piece, weight=piece.weight / total.clamp(min=1)) for piece in found]

    def all_rows(self, piece_samples: int) -> Iterator[Piece]:
        """Yield every sequence once, in pieces that fit the cache; padding has weight 0."""
        stack, rows = self.continues.shape
        network = torch.arange(stack, device=self.row_index.device)[:, None]
        everything = torch.ones((stack, rows), dtype=torch.bool, device=self.row_index.device)
        for part in even_slices(len(self), stack, max(piece_samples // self.length, 1)):
            sequence = torch.arange(part.start, part.stop, device=self.row_index.device)
            index = sequence + network * len(self)
            yield self.pieces([Piece(index, torch.ones_like(index))], everything)[0]


def over_rows(
    function: Callable[[Tensor, Timeline], Tensor], rows: Tensor, sequences: Sequences, piece_samples: int
) -> Tensor:
    """Return (P, B, F): `function` (P, rows, D) -> (P, F, rows) applied to all rows, without gradients."""
    found: Tensor | None = None
    with torch.no_grad():
        for piece in sequences.all_rows(piece_samples):
            assert piece.timeline is not None
            values = function(piece.of(rows), piece.timeline).transpose(1, 2).flatten(0, 1)
            if found is None:
                found = values.new_empty(rows.shape[0] * rows.shape[1], values.shape[1])
            used = piece.weight > 0
            found[piece.index[used]] = values[used.flatten()]
    assert found is not None
    return found.view(*rows.shape[:2], -1)
