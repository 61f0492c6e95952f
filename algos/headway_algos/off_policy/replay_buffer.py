"""Replay buffers (Lin 1992; Mnih et al. 2015), one per policy of a stack, in one set of arrays."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from headway.contracts import EnvSpec
from headway_algos.off_policy.transitions import Transitions


@dataclass(frozen=True)
class Batch:
    """b transitions per policy; fields as in `headway_algos.off_policy.transitions.Transitions`."""

    observations: Tensor
    """(P, b, D)"""
    actions: Tensor
    """(P, b) for Discrete, (P, b, A) for Box"""
    returns: Tensor
    """(P, b)"""
    discounts: Tensor
    """(P, b)"""
    next_observations: Tensor
    """(P, b, D)"""
    next_masks: Tensor | None = None
    """(P, b, A); None without action masks"""


class ReplayBuffer:
    """The newest `capacity` transitions of each of P policies, filled and drawn from independently."""

    def __init__(self, spec: EnvSpec, policies: int, capacity: int, device: torch.device) -> None:
        self.capacity, self.device = capacity, device
        size, space = spec.observation_size, spec.action_space
        kinds: dict[str, tuple[tuple[int, ...], Any]] = {
            "observations": ((size,), np.float32),
            "actions": (space.shape, space.dtype),
            "returns": ((), np.float64),
            "discounts": ((), np.float64),
            "next_observations": ((size,), np.float32),
        }
        if spec.has_action_mask:
            kinds["next_masks"] = (sum(space.options),), np.bool_
        self.arrays: dict[str, Tensor] = {
            # numpy's zeros take no memory until they are written to.
            name: torch.from_numpy(np.zeros((policies * capacity, *shape), dtype)).to(device)
            for name, (shape, dtype) in kinds.items()
        }
        self.filled = np.zeros(policies, np.int64)
        """(P,): number of stored transitions."""
        self.position = np.zeros(policies, np.int64)
        """(P,): slot of the next transition."""

    def add(self, policies: NDArray[np.int64], transitions: Transitions) -> None:
        """Store transitions in the buffers of `policies` (B,); the last `capacity` of each are kept."""
        order = np.argsort(policies, kind="stable")
        owner = policies[order]
        counts = np.bincount(owner, minlength=len(self.filled))
        starts = np.cumsum(counts) - counts
        # Position among the new transitions of the same policy: only the newest `capacity` are written,
        # because one assignment must not write a slot twice.
        rank = np.arange(len(owner)) - starts[owner]
        fits = rank >= counts[owner] - self.capacity
        order, owner, rank = order[fits], owner[fits], rank[fits]
        slots = owner * self.capacity + (self.position[owner] + rank) % self.capacity
        places = torch.from_numpy(slots).to(self.device)
        for name, array in self.arrays.items():
            array[places] = torch.from_numpy(getattr(transitions, name)[order]).to(self.device)
        self.position = (self.position + counts) % self.capacity
        self.filled = np.minimum(self.filled + counts, self.capacity)

    def draws(
        self, generators: Sequence[np.random.Generator], active: NDArray[np.bool_], shape: tuple[int, int]
    ) -> NDArray[np.int64]:
        """Draw slots (U, P, b) for U = shape[0] batches of b = shape[1] transitions.

        Each policy draws uniformly with its own generator; policies not `active` (P,) get slot 0.
        """
        drawn = np.zeros((len(self.filled), *shape), np.int64)
        for p in np.flatnonzero(active).tolist():
            drawn[p] = generators[p].integers(0, self.filled[p], shape)
        return np.moveaxis(drawn, 0, 1)

    def batch(self, slots: NDArray[np.int64], dtype: torch.dtype) -> Batch:
        """Return the transitions at `slots` (P, b), with floating-point values in `dtype`."""
        rows = slots + np.arange(len(slots))[:, None] * self.capacity
        index = torch.from_numpy(rows.ravel()).to(self.device)

        def taken(array: Tensor) -> Tensor:
            rows = array.index_select(0, index).reshape(*slots.shape, *array.shape[1:])
            return rows.to(dtype) if rows.is_floating_point() else rows

        return Batch(**{name: taken(array) for name, array in self.arrays.items()})

    def return_scale(self) -> Tensor:
        """Return the root mean square of each policy's stored returns, (P,); 1 if all are 0."""
        # Empty slots hold 0.
        norms = torch.linalg.vector_norm(self.arrays["returns"].view(len(self.filled), -1), dim=1)
        scale = norms / torch.from_numpy(self.filled).to(self.device).double().clamp(min=1).sqrt()
        return torch.where(scale > 0, scale, 1)

    def _filled_rows(self) -> Tensor:
        """Return the indices of rows that hold a transition, over all policies."""
        held = np.arange(self.capacity) < self.filled[:, None]
        return torch.from_numpy(np.flatnonzero(held)).to(self.device)

    def state_dict(self) -> dict[str, Any]:
        """Return the stored transitions, without empty slots."""
        held = self._filled_rows()
        arrays = {name: array.index_select(0, held) for name, array in self.arrays.items()}
        return {"arrays": arrays, "filled": self.filled.copy(), "position": self.position.copy()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore the result of `state_dict`."""
        self.filled, self.position = state["filled"].copy(), state["position"].copy()
        held = self._filled_rows()
        for name, array in self.arrays.items():
            array[held] = state["arrays"][name].to(self.device)
