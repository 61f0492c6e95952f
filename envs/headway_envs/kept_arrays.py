"""Snapshots of environments whose whole state is arrays: a kernel's world, and what was observed with it."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from headway.contracts import HeadwayError

Snapshot = dict[str, dict[str, NDArray[Any]]]
"""The whole state of a batch and what was observed with it: plain arrays by name, as checkpoints hold."""


def snapshot_of(world: NamedTuple, outputs: NamedTuple) -> Snapshot:
    """Copies of all arrays."""
    return {"world": _copied(world), "outputs": _copied(outputs)}


def put_back(snapshot: Snapshot, world: NamedTuple, outputs: NamedTuple, what: str) -> None:
    """Inverse of `snapshot_of`. Raises HeadwayError where arrays are others, as those of another `what`."""
    saved = {**snapshot["world"], **snapshot["outputs"]}
    for name, array in {**_named(world), **_named(outputs)}.items():
        mine = _plain(array)
        if name not in saved or mine.shape != saved[name].shape or mine.dtype != saved[name].dtype:
            raise HeadwayError(
                f"the snapshot is of another {what} or number of copies: restore it with its own"
            )
        mine[...] = saved[name]


def _named(arrays: NamedTuple) -> Mapping[str, NDArray[Any]]:
    return arrays._asdict()


def _copied(arrays: NamedTuple) -> dict[str, NDArray[Any]]:
    return {name: _plain(array).copy() for name, array in _named(arrays).items()}


def _plain(array: NDArray[Any]) -> NDArray[Any]:
    """The same memory as numbers: records become bytes."""
    return array.view(np.uint8) if array.dtype.names else array
