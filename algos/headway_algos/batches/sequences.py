"""Rows of a trajectory as sequences of a few steps, which networks with memory learn from as one.

A sequence starts from what was remembered when its first step was taken: exact in the first pass, later stale
by the steps of this one iteration. (The stored states of R2D2, Kapturowski et al. 2019, "Recurrent
Experience Replay in Distributed Reinforcement Learning", section 3, are of a replay buffer, and stale by far
more.) Gradients end at a sequence's first step (truncated backpropagation through time), and memories where
streams end within it.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from headway_algos.batches.layout import Layout, Piece, even_slices, minibatches
from headway_algos.networks.timeline import Timeline


@dataclass(frozen=True)
class Sequences:
    """S sequences of L steps for each of P networks, over its rows, B of them."""

    places: Tensor
    """(L, S): row of each step; the same for all networks."""
    filled: Tensor
    """(L, S) bool: not past the trajectory's end."""
    memory: Tensor
    """(P, S, M): what is remembered before the first step."""
    continues: Tensor
    """(P, B): 0 where a stream begins, else 1."""
    keeps: Tensor | None
    """(P, B) bool: the row changes what is remembered; None: every row does."""

    @classmethod
    def of(
        cls,
        layout: Layout,
        length: int,
        starts: NDArray[Any],
        begins: NDArray[np.bool_],
        keeps: NDArray[np.bool_],
    ) -> Self:
        """Cut at multiples of `length`, from the hidden states `starts` (ceil(T / length), C, W, M).

        `begins` and `keeps` (T, C, W) are those of `HiddenStates`. The last sequence is padded if T is no
        multiple of `length`."""
        steps, copies, _ = begins.shape
        each = copies // layout.replicas
        step = np.arange(length)[:, None] + length * np.arange(len(starts))  # (L, chunks)
        agents, within = np.arange(layout.grouping.width), np.arange(each)
        row = np.minimum(step, steps - 1)[:, None, :, None] * each + within
        row = row + (agents * steps * each)[:, None, None]
        filled = np.broadcast_to((step < steps)[:, None, :, None], row.shape).copy()
        memory = layout.rows(starts).to(layout.dtype)
        return cls(
            torch.from_numpy(row.reshape(length, -1)).to(layout.device),
            torch.from_numpy(filled.reshape(length, -1)).to(layout.device),
            memory,
            (~layout.rows(begins)).to(layout.dtype),
            None if keeps.all() else layout.rows(keeps),
        )

    def __len__(self) -> int:
        """S"""
        return self.places.shape[1]

    @property
    def length(self) -> int:
        """L"""
        return len(self.places)

    def narrow(self, policies: Tensor) -> Self:
        """Those of networks (n,) alone."""
        return replace(
            self,
            memory=self.memory[policies],
            continues=self.continues[policies],
            keeps=None if self.keeps is None else self.keeps[policies],
        )

    def holding(self, selected: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """(P, S): the sequence has one of the selected rows (P, B)."""
        held: NDArray[np.bool_] = (selected[:, self.places.cpu().numpy()] & self.filled.cpu().numpy()).any(
            axis=1
        )
        return held

    def pieces(self, of_sequences: Sequence[Piece], selected: Tensor) -> list[Piece]:
        """Pieces over sequences as pieces over their rows. Rows that are selected (P, B) weigh alike, and 1
        together; the others only lead up to them."""
        stack, rows = self.continues.shape
        network = torch.arange(stack, device=self.places.device)[:, None]
        found: list[Piece] = []
        for piece in of_sequences:
            sequence = piece.index - network * len(self)
            index = self.places[:, sequence].transpose(0, 1) + (network * rows)[..., None]
            counts = self.filled[:, sequence].transpose(0, 1) & (piece.weight > 0)[:, None]
            flat = index.flatten()
            weight = (counts.flatten(1) & selected.flatten()[flat].view(stack, -1)).to(self.continues)
            timeline = Timeline(
                self.memory.flatten(0, 1)[piece.index].transpose(1, 2),
                self.continues.flatten()[flat].view(stack, 1, -1),
                None if self.keeps is None else self.keeps.flatten()[flat].view(stack, 1, -1),
            )
            found.append(Piece(flat.view(stack, -1), weight, timeline))
        total = sum((piece.weight.sum(1, keepdim=True) for piece in found), torch.zeros(()))
        return [replace(piece, weight=piece.weight / total.clamp(min=1)) for piece in found]

    def all_rows(self, piece_samples: int) -> Iterator[Piece]:
        """Every sequence once, in pieces that stay in the cache; rows that are there have a weight."""
        stack, rows = self.continues.shape
        network = torch.arange(stack, device=self.places.device)[:, None]
        everything = torch.ones((stack, rows), dtype=torch.bool, device=self.places.device)
        for part in even_slices(len(self), stack, max(piece_samples // self.length, 1)):
            sequence = torch.arange(part.start, part.stop, device=self.places.device)
            index = sequence + network * len(self)
            yield self.pieces([Piece(index, torch.ones_like(index))], everything)[0]


def over_rows(
    function: Callable[[Tensor, Timeline], Tensor], rows: Tensor, sequences: Sequences, piece_samples: int
) -> Tensor:
    """(P, B, F) of all rows (P, B, D), by a function (P, rows, D) -> (P, F, rows) of sequences; without
    gradients."""
    found: Tensor | None = None
    with torch.no_grad():
        for piece in sequences.all_rows(piece_samples):
            assert piece.timeline is not None
            values = function(piece.of(rows), piece.timeline).transpose(1, 2).flatten(0, 1)
            if found is None:
                found = values.new_empty(rows.shape[0] * rows.shape[1], values.shape[1])
            there = piece.weight > 0
            found[piece.index[there]] = values[there.flatten()]
    assert found is not None
    return found.view(*rows.shape[:2], -1)


def learning_batches(
    selected: NDArray[np.bool_],
    sequences: Sequences | None,
    generators: Sequence[np.random.Generator],
    epochs: int,
    parts: int,
    piece_samples: int | None,
    layout: Layout,
) -> Iterator[tuple[list[Piece], NDArray[np.bool_]]]:
    """Shuffled minibatches of selected rows (P, B), or of whole sequences that hold some; a network that has
    fewer of them than minibatches takes fewer steps. See `headway_algos.batches.layout.minibatches`."""
    if sequences is None:
        yield from minibatches(selected, generators, epochs, parts, piece_samples, layout)
        return
    rows = torch.from_numpy(selected).to(layout.device)
    samples = None if piece_samples is None else max(piece_samples // sequences.length, 1)
    for pieces, active in minibatches(
        sequences.holding(selected), generators, epochs, parts, samples, layout
    ):
        yield sequences.pieces(pieces, rows), active
