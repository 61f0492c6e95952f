"""A trajectory laid out by network: rows (P, B, ...) with B = G agents x T steps x E copies."""

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
    """How arrays by agent become tensors by network, and back."""

    grouping: Grouping
    replicas: int
    """R"""
    device: torch.device
    dtype: torch.dtype

    def rows(self, by_agent: NDArray[Any], present: NDArray[np.bool_] | None = None) -> Tensor:
        """(T, C, N, ...) -> (P, B, ...); floating arrays in the layout's precision. With `present` (T, C, N),
        0 where that is false, as `zero_where_absent` has it, but without a copy of all of them in between."""
        gathered = np.require(self.grouping.gather(by_agent, self.replicas), requirements="W")
        if present is not None and not present.all():
            if np.may_share_memory(gathered, by_agent):
                gathered = gathered.copy()
            absent = ~self.grouping.gather(present, self.replicas)
            np.copyto(gathered, 0, where=absent.reshape(absent.shape + (1,) * (gathered.ndim - 2)))
        tensor = torch.from_numpy(gathered).to(self.device)
        return tensor.to(self.dtype) if tensor.is_floating_point() else tensor

    def selection(self, by_agent: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """(T, C, N) -> (P, B), false in rows of padding."""
        selected = self.grouping.gather(by_agent, self.replicas)
        if not self.grouping.is_member.all():
            members = np.tile(self.grouping.is_member, (self.replicas, 1))
            rows_each = selected.shape[1] // self.grouping.width
            selected = selected & np.repeat(members, rows_each, axis=1)
        return selected

    def by_agent(self, rows: Tensor, steps: int, agents: int | None = None) -> NDArray[np.float64]:
        """(P, B, ...) -> (T, C, N, ...) in float64; `agents`: N, where it is fewer than all."""
        return self.grouping.scatter(rows.detach().double().cpu().numpy(), self.replicas, steps, agents)


def zero_where_absent(values: NDArray[Any], present: NDArray[np.bool_]) -> NDArray[Any]:
    """Values (..., N, ...) with 0 where `present` (..., N) is false, so that no NaN found there reaches a
    product. The values given are left as they are."""
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
    """Where streams were cut by truncation, gathered so that every replica has F slots (padded)."""

    steps: NDArray[np.int64]
    """(F, R): step of each ending."""
    copies: NDArray[np.int64]
    """(F, R): copy over all replicas."""
    used: NDArray[np.bool_]
    """(F, R): not padding."""

    @classmethod
    def of(cls, trajectory: Trajectory, replicas: int) -> "Truncations":
        """All (step, copy) in which some agent was truncated and not terminated."""
        cut = (trajectory.truncated & ~trajectory.terminated).any(axis=2)
        steps, copies = np.nonzero(cut)
        replica_of = copies // (cut.shape[1] // replicas)
        lists = [np.flatnonzero(replica_of == r) for r in range(replicas)]
        width = max(len(places) for places in lists)
        table = np.stack(
            [np.pad(places, (0, width - len(places)), constant_values=-1) for places in lists], 1
        )
        safe = np.maximum(table, 0)
        if width == 0:
            return cls(table, table, table >= 0)
        return cls(steps[safe], copies[safe], table >= 0)

    def __len__(self) -> int:
        """F"""
        return len(self.steps)

    def take(self, array: NDArray[Any]) -> NDArray[Any]:
        """Rows of an array (T, C, ...) at the endings: (F, R, ...)."""
        taken: NDArray[Any] = array[self.steps, self.copies]
        return taken

    def put(self, values: NDArray[Any], shape: tuple[int, ...]) -> NDArray[np.float64]:
        """Values (F, R, N) at their places in zeros of shape (T, C, N)."""
        result = np.zeros(shape)
        result[self.steps[self.used], self.copies[self.used]] = values[self.used]
        return result


def even_slices(rows: int, stack: int, piece_samples: int) -> list[slice]:
    """Cuts rows into as few equal pieces as keep `stack` x rows of each within `piece_samples`."""
    pieces = min(-(-rows * stack // piece_samples), rows)
    edges = [rows * i // pieces for i in range(pieces + 1)] if pieces else []
    return [slice(start, end) for start, end in pairwise(edges)]


TAKEN_AHEAD = 16_384
"""Samples, over all policies of a stack, that small minibatches take at once: one after another they would
wait for memory, wherever each row lies, again and again."""


class Ahead:
    """Rows of the next k minibatches, taken at once, the first time that somebody asks for them."""

    def __init__(self, index: Tensor) -> None:
        """`index` (k, P, W): places in the flattened (P x B) rows."""
        self.index = index
        self._taken: dict[int, tuple[Tensor, Tensor]] = {}

    def of(self, rows: Tensor) -> Tensor:
        """Of rows (P, B, ...): (k, P, W, ...)."""
        # With the rows themselves, so that nothing else comes to stand where they do.
        known = self._taken.get(id(rows))
        if known is None:
            taken = rows.reshape(-1, *rows.shape[2:]).index_select(0, self.index.flatten())
            known = self._taken[id(rows)] = rows, taken.view(*self.index.shape, *rows.shape[2:])
        return known[1]


@dataclass(frozen=True)
class Piece:
    """Rows to work on at once, for every network of a stack."""

    index: Tensor
    """(P, rows): places in the flattened (P x B) rows."""
    weight: Tensor
    """(P, rows): 1 / (rows of this network's minibatch), 0 in padding."""
    timeline: Timeline | None = None
    """Their order, for networks that remember."""
    ahead: tuple[Ahead, int] | None = None
    """What holds them, and where among its k."""

    def of(self, rows: Tensor) -> Tensor:
        """This piece of rows (P, B, ...): (P, rows, ...)."""
        if self.ahead is not None:
            held, place = self.ahead
            return held.of(rows)[place, :, : self.index.shape[1]]
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
    """Shuffled minibatches: a list of pieces whose gradients add up to the minibatch's, and which networks
    have rows in it, (P,).

    Every network shuffles its own selected rows (P, B) with its own generator and cuts them into `parts`
    equal minibatches, whatever the others have: so a network's updates do not depend on its stack.
    `piece_samples` is the most samples, over all networks, of a piece; None: a minibatch is one piece.
    Padding repeats a selected row of the same network, if it has any.
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
    del shares  # as many as there are rows
    together = TAKEN_AHEAD // max(stack * len(within), 1)
    # Of each network's shuffled rows; past a minibatch's end is padding.
    places = np.minimum(edges[:-1, :, None] + within, np.maximum(counts - 1, 0)[:, None])
    for _ in range(epochs):
        index = np.empty(places.shape, np.int64)
        for p, rows in enumerate(candidates):
            # A gradient over all rows needs no order.
            shuffled = generators[p].permutation(rows) if parts > 1 else rows
            index[:, p] = p * batch + (shuffled[places[:, p]] if len(rows) else 0)
        indices = torch.from_numpy(index).to(layout.device)
        ahead, block = None, -1
        for part, width in enumerate(widths):
            if together > 1 and 0 < width * stack <= piece_samples:
                if ahead is None or block != part // together:
                    block = part // together
                    ahead = Ahead(indices[block * together : (block + 1) * together])
                held = (ahead, part % together)
                pieces = [Piece(indices[part, :, :width], weights[part, :, :width], ahead=held)]
            else:
                cuts = even_slices(width, stack, piece_samples)
                pieces = [Piece(indices[part, :, rows], weights[part, :, rows]) for rows in cuts]
            yield pieces, active[part]
