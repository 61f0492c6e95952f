"""Batched environments whose whole state is arrays: a kernel's world, and what was observed with it."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any, ClassVar, Generic, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from headway.contracts import EnvSpec, HeadwayError, Observed

Snapshot = dict[str, dict[str, NDArray[Any]]]
"""The whole state of a batch and what was observed with it: plain arrays by name, as checkpoints hold."""


WorldT = TypeVar("WorldT", bound=NamedTuple)
OutputsT = TypeVar("OutputsT", bound=NamedTuple)


class KeptArrays(ABC, Generic[WorldT, OutputsT]):
    """What `headway.contracts.BatchedEnv` asks for but `step`, for C copies whose state is in `world` and
    `outputs` alone. A subclass sets both, each with the copies first, and `_spec`."""

    world: WorldT
    outputs: OutputsT
    _spec: EnvSpec
    _KIND: ClassVar[str]
    """What must be the same where a snapshot is restored."""

    @property
    def spec(self) -> EnvSpec:
        return self._spec

    @property
    def num_copies(self) -> int:
        return len(self.world[0])

    @abstractmethod
    def observed(self) -> Observed:
        """What the agents face now; views of the environment's arrays."""

    @abstractmethod
    def _begin(self, seeds: NDArray[np.uint64]) -> None:
        """Episode 0 of every copy, from zeros; seeds (C,)."""

    def reset(self, seeds: NDArray[np.uint64]) -> Observed:
        """Begin episode 0 of every copy; seeds (C,). Raises ValueError for another shape."""
        seeds = np.ascontiguousarray(seeds, np.uint64)
        if seeds.shape != (self.num_copies,):
            raise ValueError(f"seeds must have shape ({self.num_copies},), not {seeds.shape}")
        for name, array in {**_named(self.world), **_named(self.outputs)}.items():
            # The end before stays: the adapter of a ParallelEnv begins anew before the end can be drawn.
            if not name.startswith("final_"):
                array[...] = np.zeros(1, array.dtype)
        self._begin(seeds)
        return self.observed()

    def snapshot(self) -> Snapshot:
        """Copies of all arrays."""
        return {"world": copied(_named(self.world)), "outputs": copied(_named(self.outputs))}

    def restore(self, snapshot: Snapshot) -> Observed:
        """Continue from a snapshot. Raises HeadwayError where `_KIND` or the number of copies is another."""
        saved = {**snapshot["world"], **snapshot["outputs"]}
        for name, array in {**_named(self.world), **_named(self.outputs)}.items():
            mine = _plain(array)
            if name not in saved or mine.shape != saved[name].shape or mine.dtype != saved[name].dtype:
                raise HeadwayError(
                    f"the snapshot is of another {self._KIND} or number of copies: restore it with its own"
                )
            mine[...] = saved[name]
        return self.observed()

    def close(self) -> None:
        """Nothing is held open."""
        return

    def _checked(self, actions: NDArray[Any]) -> NDArray[np.int64]:
        """A copy of actions (C, N), as a kernel may replace some. Raises ValueError for another shape."""
        wanted = (self.num_copies, len(self._spec.agents))
        if np.shape(actions) != wanted:
            raise ValueError(f"actions must have shape {wanted}, not {np.shape(actions)}")
        return np.array(actions, np.int64, order="C")


def _named(arrays: NamedTuple) -> Mapping[str, NDArray[Any]]:
    return arrays._asdict()


def copied(arrays: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    """As a snapshot holds them."""
    return {name: _plain(array).copy() for name, array in arrays.items()}


def _plain(array: NDArray[Any]) -> NDArray[Any]:
    """The same memory as numbers: records become bytes."""
    return array.view(np.uint8) if array.dtype.names else array
