"""States of learners: tensors and plain values in nested dictionaries and lists."""

from collections.abc import Callable, Mapping
from typing import Any

import torch
from torch import Tensor


def map_tensors(function: Callable[..., Tensor], *states: Any) -> Any:  # noqa: ANN401 - nested plain values
    """Return the first state with each tensor replaced by `function` of it and its counterparts.

    Counterparts are the tensors at the same place in the other states. All other values are those of the
    first state.
    """
    first = states[0]
    if isinstance(first, Tensor):
        return function(*states)
    if isinstance(first, Mapping):
        return {name: map_tensors(function, *(state[name] for state in states)) for name in first}
    if isinstance(first, list):
        return [map_tensors(function, *parts) for parts in zip(*states, strict=True)]
    return first


def replica_state(state: Any, replica: int, replicas: int, copies: int) -> Any:  # noqa: ANN401 - as above
    """Return the state of replica `replica` out of `replicas`, repeated for `copies` replicas."""

    def repeated(tensor: Tensor) -> Tensor:
        own = torch.tensor_split(tensor, replicas)[replica]
        return own.repeat(copies, *[1] * (own.dim() - 1))

    return map_tensors(repeated, state)


def same_shapes(one: object, other: object) -> bool:
    """Return whether two states have the same tensors, by name and shape."""
    if isinstance(one, Mapping) and isinstance(other, Mapping):
        return one.keys() == other.keys() and all(same_shapes(one[name], other[name]) for name in one)
    return not isinstance(one, Tensor) or (isinstance(other, Tensor) and one.shape == other.shape)


def trained_state(state: dict[str, Any]) -> dict[str, Any]:
    """Return the state of a learner; for a `SplitLearner`, that of the learner inside it."""
    inner: dict[str, Any] = state["learner"] if "parted" in state else state
    return inner
