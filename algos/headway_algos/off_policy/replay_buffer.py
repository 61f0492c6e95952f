"""Replay memories (Lin 1992; Mnih et al. 2015), one for each policy of a stack, as one set of arrays."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from headway.contracts import Box, Discrete, EnvSpec
from headway_algos.off_policy.transitions import Transitions


@dataclass(frozen=True)
class Batch:
    """b transitions of each policy."""

    observations: Tensor
    """(P, b, D)"""
    actions: Tensor
    """(P, b) or (P, b, A)"""
    returns: Tensor
    """(P, b)"""
    discounts: Tensor
    """(P, b)"""
    next_observations: Tensor
    """(P, b, D)"""
    next_masks: Tensor | None
    """(P, b, A)"""


class ReplayBuffer:
    """The newest `capacity` transitions of each of P policies. A policy's is filled and drawn from by itself,
    whatever the others of its stack have."""

    def __init__(self, spec: EnvSpec, policies: int, capacity: int, device: torch.device) -> None:
        self.capacity, self.device = capacity, device
        size = spec.observation_size
        actions: tuple[tuple[int, ...], Any] = ((), np.int64)
        if isinstance(spec.action_space, Box):
            actions = (spec.action_space.size,), np.float32
        kinds: dict[str, tuple[tuple[int, ...], Any]] = {
            "observations": ((size,), np.float32),
            "actions": actions,
            "returns": ((), np.float64),
            "discounts": ((), np.float64),
            "next_observations": ((size,), np.float32),
        }
        if spec.has_action_mask and isinstance(spec.action_space, Discrete):
            kinds["next_masks"] = (spec.action_space.n,), np.bool_
        self.arrays: dict[str, Tensor] = {
            # numpy's zeros take no memory until they are written to.
            name: torch.from_numpy(np.zeros((policies * capacity, *shape), dtype)).to(device)
            for name, (shape, dtype) in kinds.items()
        }
        self.filled = np.zeros(policies, np.int64)
        """(P,): transitions held."""
        self.position = np.zeros(policies, np.int64)
        """(P,): where the next one goes."""

    def add(self, policies: NDArray[np.int64], transitions: Transitions) -> None:
        """Remember transitions, each for its policy (B,); of more than fit the last stay."""
        order = np.argsort(policies, kind="stable")
        owner = policies[order]
        counts = np.bincount(owner, minlength=len(self.filled))
        starts = np.cumsum(counts) - counts
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
        """Places (U, P, b) for U = shape[0] batches of b = shape[1], each policy's uniform over what it holds
        and by its own generator; place 0 of a policy that is not `active` (P,)."""
        drawn = np.zeros((len(self.filled), *shape), np.int64)
        for p in np.flatnonzero(active).tolist():
            drawn[p] = generators[p].integers(0, self.filled[p], shape)
        return np.moveaxis(drawn, 0, 1)

    def batch(self, places: NDArray[np.int64], dtype: torch.dtype) -> Batch:
        """The transitions at places (P, b), floating numbers in `dtype`."""
        rows = places + np.arange(len(places))[:, None] * self.capacity
        index = torch.from_numpy(rows.ravel()).to(self.device)

        def taken(name: str) -> Tensor:
            array = self.arrays[name]
            rows = array.index_select(0, index).reshape(*places.shape, *array.shape[1:])
            return rows.to(dtype) if rows.is_floating_point() else rows

        return Batch(
            observations=taken("observations"),
            actions=taken("actions"),
            returns=taken("returns"),
            discounts=taken("discounts"),
            next_observations=taken("next_observations"),
            next_masks=taken("next_masks") if "next_masks" in self.arrays else None,
        )

    def _held(self) -> Tensor:
        """Rows of all policies that hold a transition."""
        held = np.arange(self.capacity) < self.filled[:, None]
        return torch.from_numpy(np.flatnonzero(held)).to(self.device)

    def state_dict(self) -> dict[str, Any]:
        """What is held, and no more."""
        held = self._held()
        arrays = {name: array.index_select(0, held) for name, array in self.arrays.items()}
        return {"arrays": arrays, "filled": self.filled.copy(), "position": self.position.copy()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Inverse of `state_dict`."""
        self.filled, self.position = state["filled"].copy(), state["position"].copy()
        held = self._held()
        for name, array in self.arrays.items():
            array[held] = state["arrays"][name].to(self.device)
