"""Rearrangement of trajectories to rows (P, B, ...) per network, B = G agents x T steps x E copies."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from headway.contracts import Trajectory
from headway_algos.grouping import Grouping
from headway_algos.networks.timeline import Timeline


@dataclass(frozen=True)
class Layout:
    """Converts arrays by agent to tensors by network, and back."""

    grouping: Grouping
    replicas: int
    """R: replicas."""
    device: torch.device
    dtype: torch.dtype

    def rows(self, by_agent: NDArray[Any], present: NDArray[np.bool_] | None = None) -> Tensor:
        """Convert (T, C, N, ...) to (P, B, ...), floating-point values in the layout's dtype.

        Rows where `present` (T, C, N) is false become 0. Unlike `zero_where_absent` this makes no extra copy.
        """
        gathered = np.require(self.grouping.gather(by_agent, self.replicas), requirements="W")
        if present is not None and not present.all():
            if np.may_share_memory(gathered, by_agent):
                gathered = gathered.copy()
            absent = ~self.grouping.gather(present, self.replicas)
            np.copyto(gathered, 0, where=absent.reshape(absent.shape + (1,) * (gathered.ndim - 2)))
        tensor = torch.from_numpy(gathered).to(self.device)
        return tensor.to(self.dtype) if tensor.is_floating_point() else tensor

    def selection(self, by_agent: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Convert a mask (T, C, N) to (P, B), false in rows of padding."""
        selected = self.grouping.gather(by_agent, self.replicas)
        if not self.grouping.is_member.all():
            members = np.tile(self.grouping.is_member, (self.replicas, 1))
            rows_per_agent = selected.shape[1] // self.grouping.width
            selected = selected & np.repeat(members, rows_per_agent, axis=1)
        return selected

    def by_agent(self, rows: Tensor, steps: int, agents: int | None = None) -> NDArray[np.float64]:
        """Convert (P, B, ...) to (T, C, N, ...) in float64; `agents` is N if fewer than all agents."""
        return self.grouping.scatter(rows.detach().double().cpu().numpy(), self.replicas, steps, agents)


def zero_where_absent(values: NDArray[Any], present: NDArray[np.bool_]) -> NDArray[Any]:
    """Return values (..., N, ...) with 0 where `present` (..., N) is false; `values` stays unchanged.

    Keeps NaN of absent agents out of products.
    """
    if present.all():
        return values
    spread = present.reshape(present.shape + (1,) * (values.ndim - present.ndim))
    return np.where(spread, values, 0).astype(values.dtype, copy=False)


def last_known_masks(
    trajectory: Trajectory,
    until: tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]],
    earlier: NDArray[np.bool_] | Literal[True] = True,
) -> NDArray[np.bool_]:
    """Return action masks (..., A) of the last step up to `until` (steps, copies, agents, each (...)) with
    the agent alive, or `earlier` (..., A) if there is none. No mask is recorded for a final observation:
    this one is the nearest known."""
    steps, copies, agents = until
    seen = np.where(trajectory.alive[:-1], np.arange(len(trajectory.rewards))[:, None, None], -1)
    last = np.maximum.accumulate(seen)[steps, copies, agents]
    return np.where(last[..., None] >= 0, trajectory.action_masks[last, copies, agents], earlier)


@dataclass(frozen=True)
class Truncations:
    """Time points at which streams were truncated, padded to F per replica."""

    steps: NDArray[np.int64]
    """(F, R): step of the truncation."""
    copies: NDArray[np.int64]
    """(F, R): copy, counted over all replicas."""
    used: NDArray[np.bool_]
    """(F, R): False for padding."""

    @classmethod
    def of(cls, trajectory: Trajectory, replicas: int) -> "Truncations":
        """Return all (step, copy) at which an agent was truncated and not terminated."""
        cut = (trajectory.truncated & ~trajectory.terminated).any(axis=2)
        steps, copies = np.nonzero(cut)
        replica_of = copies // (cut.shape[1] // replicas)
        lists = [np.flatnonzero(replica_of == r) for r in range(replicas)]
        width = max(len(positions) for positions in lists)
        table = np.stack(
            [np.pad(positions, (0, width - len(positions)), constant_values=-1) for positions in lists], 1
        )
        safe = np.maximum(table, 0)
        if width == 0:
            return cls(table, table, table >= 0)
        return cls(steps[safe], copies[safe], table >= 0)

    def __len__(self) -> int:
        """F."""
        return len(self.steps)

    def take(self, array: NDArray[Any]) -> NDArray[Any]:
        """Return the rows of an array (T, C, ...) at the truncations, (F, R, ...)."""
        taken: NDArray[Any] = array[self.steps, self.copies]
        return taken

    def put(self, values: NDArray[Any], shape: tuple[int, ...]) -> NDArray[np.float64]:
        """Return zeros of `shape` (T, C, N) with `values` (F, R, N) inserted at the truncations."""
        result = np.zeros(shape)
        result[self.steps[self.used], self.copies[self.used]] = values[self.used]
        return result


def even_slices(rows: int, stack: int, piece_samples: int) -> list[slice]:
    """Split rows into the fewest equal pieces of at most `piece_samples` samples, `stack` per row."""
    pieces = min(-(-rows * stack // piece_samples), rows)
    edges = [rows * i // pieces for i in range(pieces + 1)] if pieces else []
    return [slice(start, end) for start, end in pairwise(edges)]


PREFETCH_SAMPLES = 16_384
"""Samples, over all policies of a stack, that small minibatches gather together. Gathering each minibatch
separately would be bound by memory latency."""


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
    """Cache that holds the rows, and the index of this minibatch, below k."""

    def of(self, rows: Tensor) -> Tensor:
        """Return this piece's rows (P, rows, ...) of (P, B, ...)."""
        if self.prefetched is not None:
            cache, number = self.prefetched
            return cache.of(rows)[number, :, : self.index.shape[1]]
        taken = rows.reshape(-1, *rows.shape[2:]).index_select(0, self.index.flatten())
        return taken.reshape(self.weight.shape + rows.shape[2:])


def minibatches(
    selected: NDArray[np.bool_],
    generators: Sequence[np.random.Generator],
    epochs: int,
    parts: int,
    piece_samples: int | None,
    layout: Layout,
) -> Iterator[tuple[list[Piece], NDArray[np.bool_]]]:
    """Yield shuffled minibatches: pieces whose gradients sum to the minibatch's, and a mask (P,) of networks
    with rows in it.

    Each network shuffles its own selected rows (P, B) with its own generator and cuts them into `parts` equal
    minibatches, so that their rows do not depend on its stack. A piece holds at most `piece_samples` samples
    of all networks together; None: a minibatch is one piece. Padding repeats a selected row of the same
    network, if it has any.
    """
    stack, batch = selected.shape
    if piece_samples is None:
        piece_samples = max(selected.size, 1)
    candidates = [np.flatnonzero(row) for row in selected]
    counts = np.array([len(rows) for rows in candidates])
    edges = counts * np.arange(parts + 1)[:, None] // parts
    sizes = np.diff(edges, axis=0)  # (parts, P)
    widths, active = sizes.max(axis=1).tolist(), sizes > 0
    within = np.arange(max(widths))
    shares = (1 / np.maximum(sizes, 1))[..., None] * (within < sizes[..., None])
    weights = torch.from_numpy(shares).to(layout.device, layout.dtype)
    del shares  # as large as all rows
    per_block = PREFETCH_SAMPLES // max(stack * len(within), 1)
    # Positions among a network's shuffled rows; those past a minibatch's end are padding.
    positions = np.minimum(edges[:-1, :, None] + within, np.maximum(counts - 1, 0)[:, None])
    for _ in range(epochs):
        index = np.empty(positions.shape, np.int64)
        for p, rows in enumerate(candidates):
            # A gradient over all rows needs no order.
            shuffled = generators[p].permutation(rows) if parts > 1 else rows
            index[:, p] = p * batch + (shuffled[positions[:, p]] if len(rows) else 0)
        indices = torch.from_numpy(index).to(layout.device)
        cache, block = None, -1
        for part, width in enumerate(widths):
            if per_block > 1 and 0 < width * stack <= piece_samples:
                if cache is None or block != part // per_block:
                    block = part // per_block
                    cache = Prefetched(indices[block * per_block : (block + 1) * per_block])
                prefetched = (cache, part % per_block)
                pieces = [Piece(indices[part, :, :width], weights[part, :, :width], prefetched=prefetched)]
            else:
                cuts = even_slices(width, stack, piece_samples)
                pieces = [Piece(indices[part, :, rows], weights[part, :, rows]) for rows in cuts]
            yield pieces, active[part]
