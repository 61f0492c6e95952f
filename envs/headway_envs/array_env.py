"""Base class of batched environments whose whole state is NumPy arrays: the kernel's world and its
outputs."""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, Generic, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from headway.contracts import BatchedEnv, EnvSpec, HeadwayError, Observations, StepResult
from headway.contracts.environment import step_arrays, step_result

Snapshot = dict[str, dict[str, NDArray[Any]]]
"""Whole state of a batch with its current observations, as checkpoints hold it: {"world" or "outputs": {name:
plain array}}."""


WorldT = TypeVar("WorldT", bound=NamedTuple)
OutputsT = TypeVar("OutputsT", bound=NamedTuple)


class ArrayEnv(ABC, Generic[WorldT, OutputsT]):
    """Implementation of `headway.contracts.BatchedEnv`, except `step`, for C copies whose whole state is the
    arrays of `world` and `outputs`.

    A subclass sets `world`, `outputs` (axis C first in each array), `_spec` and `_outcome`.
    """

    world: WorldT
    outputs: OutputsT
    _spec: EnvSpec
    _outcome: StepResult
    """Result of the last step: `_result` of the arrays that steps fill."""
    _KIND: ClassVar[str]
    """Noun for the error message of `restore`: what must match between snapshot and environment."""

    @property
    def spec(self) -> EnvSpec:
        return self._spec

    @property
    def num_copies(self) -> int:
        return len(self.world[0])

    @abstractmethod
    def observed(self) -> Observations:
        """Return the current observations, states, alive mask and action masks: views of the environment's
        arrays."""

    @abstractmethod
    def _begin(self, seeds: NDArray[np.uint64]) -> None:
        """Begin episode 0 of every copy; all arrays are zero on entry, except those named `final_*`. Seeds
        (C,)."""

    def reset(self, seeds: NDArray[np.uint64]) -> Observations:
        """Begin episode 0 of every copy; seeds (C,). Raises ValueError for another shape."""
        seeds = np.ascontiguousarray(seeds, np.uint64)
        if seeds.shape != (self.num_copies,):
            raise ValueError(f"seeds must have shape ({self.num_copies},), not {seeds.shape}")
        for name, array in {**_named(self.world), **_named(self.outputs)}.items():
            # Keep the last episode's end: the ParallelEnv adapter resets before that end can be painted.
            if not name.startswith("final_"):
                array[...] = np.zeros(1, array.dtype)
        self._begin(seeds)
        return self.observed()

    def snapshot(self) -> Snapshot:
        """Return copies of all arrays."""
        return {"world": copied(_named(self.world)), "outputs": copied(_named(self.outputs))}

    def restore(self, snapshot: Snapshot) -> Observations:
        """Continue from a snapshot and return its observations. Raises HeadwayError if `_KIND` or the number
        of copies differs."""
        saved = {**snapshot["world"], **snapshot["outputs"]}
        for name, array in {**_named(self.world), **_named(self.outputs)}.items():
            mine = _plain(array)
            if name not in saved or mine.shape != saved[name].shape or mine.dtype != saved[name].dtype:
                raise HeadwayError(
                    f"the snapshot is of another {self._KIND} or number of copies: restore it in a "
                    "matching environment"
                )
            mine[...] = saved[name]
        return self.observed()

    def branch_from(
        self, source: BatchedEnv, rows: NDArray[np.int64], seeds: NDArray[np.uint64]
    ) -> Observations:
        """Continue copy c from the present state of copy `rows[c]` of `source`, another batch of the same
        environment, with random numbers that follow from seeds[c]; rows and seeds (C,)."""
        assert isinstance(source, type(self))
        for mine, theirs in ((self.world, source.world), (self.outputs, source.outputs)):
            for array, other in zip(mine, theirs, strict=True):
                np.take(other, rows, axis=0, out=array, mode="clip")
        self._redraw(seeds)
        return self.observed()

    def _redraw(self, seeds: NDArray[np.uint64]) -> None:
        """Replace the random events that have been drawn for the future of every copy; seeds (C,). Raises
        HeadwayError for environments that do not support `lookahead`, to be overridden by those that do."""
        raise HeadwayError(f"{self._spec.name} cannot be simulated ahead: leave out the rule lookahead")

    def close(self) -> None:
        """Do nothing: the environment holds no open resources."""
        return

    def _arrays(self, copies: int, names: Sequence[str]) -> dict[str, NDArray[Any]]:
        """Return the arrays of these names that steps fill. Raises HeadwayError for fewer than one copy."""
        if copies < 1:
            raise HeadwayError(f"copies must be at least 1, not {copies}")
        arrays = step_arrays(self._spec, copies)
        return {name: arrays[name] for name in names if name in arrays}

    def _result(self, **others: NDArray[Any]) -> StepResult:
        """Return the result made of `outputs` and of `others`, which `outputs` lacks."""
        return step_result({**_named(self.outputs), **others})

    def _checked(self, actions: NDArray[Any]) -> NDArray[np.int64]:
        """Return an int64 copy of actions (C, N); a copy, because a kernel may replace some of them. Raises
        ValueError for any other shape."""
        wanted = (self.num_copies, len(self._spec.agents))
        if np.shape(actions) != wanted:
            raise ValueError(f"actions must have shape {wanted}, not {np.shape(actions)}")
        return np.array(actions, np.int64, order="C")


def _named(arrays: NamedTuple) -> Mapping[str, NDArray[Any]]:
    return arrays._asdict()


def copied(arrays: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    """Return copies of the arrays in a snapshot's format: by name, records as bytes."""
    return {name: _plain(array).copy() for name, array in arrays.items()}


def record(dtype: np.dtype[np.void], values: Mapping[str, float]) -> NDArray[np.void]:
    """Return an array (1,) of a record type with these values of its fields, and 0 in others."""
    made = np.zeros(1, dtype)
    for name, value in values.items():
        made[name] = value
    return made


def _plain(array: NDArray[Any]) -> NDArray[Any]:
    """View an array as plain numbers, without a copy: record arrays become bytes."""
    return array.view(np.uint8) if array.dtype.names else array
