"""Minibatches on which networks are trained in one iteration."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from headway_algos.batches.layout import Layout
from headway_algos.batches.minibatches import Piece, minibatches, shuffled_epochs
from headway_algos.batches.sequences import Sequences


@dataclass(frozen=True)
class MinibatchSchedule:
    """Passes over the selected rows of P networks, each in shuffled minibatches.

    Recurrent networks learn from whole sequences that contain selected rows. A network with fewer rows (or
    sequences) than minibatches takes fewer steps.
    """

    selected: NDArray[np.bool_]
    """(P, B): rows to train on."""
    sequences: Sequences | None
    """Order of the rows in time, for recurrent networks; else None."""
    generators: Sequence[np.random.Generator]
    """Generators for shuffling, one per network."""
    epochs: int
    minibatches: int
    """Minibatches per epoch."""
    piece_samples: int
    """Maximum number of samples in a piece, over all networks."""
    layout: Layout

    def row_indices(self) -> Iterator[tuple[NDArray[np.int64], NDArray[np.int64]]]:
        """Yield each epoch's minibatches as `shuffled_epochs` does; for networks that are not recurrent."""
        return shuffled_epochs(self.selected, self.generators, self.epochs, self.minibatches)

    def pieces(self) -> Iterator[tuple[list[Piece], NDArray[np.bool_]]]:
        """Yield each minibatch as pieces, with a mask (P,) of networks that have rows in it."""
        shuffled = (self.generators, self.epochs, self.minibatches)
        if self.sequences is None:
            yield from minibatches(self.selected, *shuffled, self.piece_samples, self.layout)
            return
        rows = torch.from_numpy(self.selected).to(self.layout.device)
        samples = max(self.piece_samples // self.sequences.length, 1)
        held = self.sequences.holding(self.selected)
        for pieces, active in minibatches(held, *shuffled, samples, self.layout):
            yield self.sequences.pieces(pieces, rows), active
