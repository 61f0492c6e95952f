"""Shuffled minibatches of rows, and the pieces in which they pass through the networks."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from headway_algos.batches.layout import Layout
from headway_algos.networks.timeline import Timeline


def even_slices(rows: int, stack: int, piece_samples: int) -> list[slice]:
    """Split rows into the fewest equal pieces of at most `piece_samples` samples.

    A row counts once per network of the stack.
    """
    pieces = min(-(-rows * stack // piece_samples), rows)
    edges = [rows * i // pieces for i in range(pieces + 1)] if pieces else []
    return [slice(start, end) for start, end in pairwise(edges)]


PREFETCH_SAMPLES = 16_384
"""Samples, over all policies of a stack, up to which small minibatches are gathered in one operation.

Gathering each minibatch separately would be bound by memory latency.
"""


class Prefetched:
    """Rows of the next k minibatches, gathered together at first use."""

    def __init__(self, index: Tensor) -> None:
        """`index` (k, P, W): indices of the flattened (P x B) rows."""
        self.index = index
        self._cache: dict[int, tuple[Tensor, Tensor]] = {}

    def of(self, rows: Tensor) -> Tensor:
        """Return the gathered rows (k, P, W, ...) of `rows` (P, B, ...)."""
        # Holding `rows` keeps its id from being reused.
        cached = self._cache.get(id(rows))
        if cached is None:
            taken = rows.reshape(-1, *rows.shape[2:]).index_select(0, self.index.flatten())
            cached = self._cache[id(rows)] = rows, taken.view(*self.index.shape, *rows.shape[2:])
        return cached[1]


@dataclass(frozen=True)
class Piece:
    """Rows of a minibatch that are processed together, for every network of a stack."""

    index: Tensor
    """(P, rows): indices of the flattened (P x B) rows."""
    weight: Tensor
    """(P, rows): 1 / (rows of this network's minibatch), 0 for padding."""
    timeline: Timeline | None = None
    """Order of the rows in time, for recurrent networks."""
    prefetched: tuple[Prefetched, int] | None = None
    """Cache that contains the rows, and this minibatch's index in it (0 to k - 1)."""

    def of(self, rows: Tensor) -> Tensor:
        """Return this piece's rows (P, rows, ...) of (P, B, ...)."""
        if self.prefetched is not None:
            cache, number = self.prefetched
            return cache.of(rows)[number, :, : self.index.shape[1]]
        taken = rows.reshape(-1, *rows.shape[2:]).index_select(0, self.index.flatten())
        return taken.reshape(self.weight.shape + rows.shape[2:])


def shuffled_epochs(
    selected: NDArray[np.bool_], generators: Sequence[np.random.Generator], epochs: int, parts: int
) -> Iterator[tuple[NDArray[np.int64], NDArray[np.int64]]]:
    """Yield the minibatches of each epoch as row indices (parts, P, W) and row counts (parts, P).

    Indices are those of the flattened (P x B) rows; beyond a minibatch's count they are padding, which
    repeats a selected row of the same network, if it has any. The selected rows (P, B) of each network are
    shuffled with its own generator and cut into `parts` equal minibatches, independently of the other
    networks.
    """
    batch = selected.shape[1]
    candidates = [p * batch + np.flatnonzero(row) for p, row in enumerate(selected)]
    counts = np.array([len(rows) for rows in candidates])
    edges = counts * np.arange(parts + 1)[:, None] // parts
    sizes = np.diff(edges, axis=0)
    # Positions in a network's shuffled rows; those past a minibatch's end are padding.
    positions = np.minimum(edges[:-1, :, None] + np.arange(sizes.max()), np.maximum(counts - 1, 0)[:, None])
    for _ in range(epochs):
        index = np.empty(positions.shape, np.int64)
        for p, rows in enumerate(candidates):
            # One minibatch of all rows: the order does not matter.
            shuffled = generators[p].permutation(rows) if parts > 1 else rows
            index[:, p] = shuffled.take(positions[:, p]) if len(rows) else p * batch
        yield index, sizes


def minibatches(
    selected: NDArray[np.bool_],
    generators: Sequence[np.random.Generator],
    epochs: int,
    parts: int,
    piece_samples: int,
    layout: Layout,
) -> Iterator[tuple[list[Piece], NDArray[np.bool_]]]:
    """Yield each minibatch of `shuffled_epochs` as pieces, with a mask (P,) of networks that have rows in it.

    The gradients of the pieces sum to the minibatch's. A piece contains at most `piece_samples` samples over
    all networks.
    """
    stack = len(selected)
    weights: Sequence[Tensor] | None = None
    for index, sizes in shuffled_epochs(selected, generators, epochs, parts):
        indices = torch.from_numpy(index).to(layout.device)
        if weights is None:
            within = np.arange(index.shape[2]) < sizes[..., None]
            shares = (1 / np.maximum(sizes, 1))[..., None] * within
            weights = torch.from_numpy(shares).to(layout.device, layout.dtype).unbind()
            del shares, within  # each is as large as all rows
        per_block = PREFETCH_SAMPLES // max(stack * index.shape[2], 1)
        by_part, cache, block = indices.unbind(), None, -1
        for part, width in enumerate(sizes.max(axis=1).tolist()):
            if per_block > 1 and 0 < width * stack <= piece_samples:
                if cache is None or block != part // per_block:
                    block = part // per_block
                    cache = Prefetched(indices[block * per_block : (block + 1) * per_block])
                prefetched = (cache, part % per_block)
                pieces = [Piece(by_part[part][:, :width], weights[part][:, :width], prefetched=prefetched)]
            else:
                cuts = even_slices(width, stack, piece_samples)
                pieces = [Piece(by_part[part][:, rows], weights[part][:, rows]) for rows in cuts]
            yield pieces, sizes[part] > 0
