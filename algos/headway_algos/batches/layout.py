"""Rearrangement of trajectories to rows (P, B, ...) per network, B = G agents x T steps x E copies."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from headway_algos.grouping import Grouping


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
        """Convert (P, B, ...) to (T, C, N, ...) in float64.

        `agents`: N, if the rows contain the first agents only.
        """
        return self.grouping.scatter(rows.detach().double().cpu().numpy(), self.replicas, steps, agents)


def zero_where_absent(values: NDArray[Any], present: NDArray[np.bool_]) -> NDArray[Any]:
    """Return values (..., N, ...) with 0 where `present` (..., N) is false; `values` stays unchanged.

    Keeps NaN of absent agents out of products.
    """
    if present.all():
        return values
    spread = present.reshape(present.shape + (1,) * (values.ndim - present.ndim))
    return np.where(spread, values, 0).astype(values.dtype, copy=False)


def mean_per_replica(values: Tensor, replicas: int) -> NDArray[np.float64]:
    """Return the mean over each replica's networks, (R,), of values (P,).

    NaN values, of networks that took no step, are left out; the mean is NaN if all values are.
    """
    table = values.double().cpu().numpy().reshape(replicas, -1)
    known = ~np.isnan(table)
    count = known.sum(axis=1)
    total = np.where(known, table, 0).sum(axis=1)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)
