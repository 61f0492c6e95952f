"""States of learners: tensors and plain values in nested dictionaries and lists."""

from collections.abc import Callable, Mapping
from typing import Any

from torch import Tensor


def map_tensors(function: Callable[..., Tensor], *states: Any) -> Any:  # noqa: ANN401 - nested plain values
    """Return the first state with each tensor replaced by `function` of it and its counterparts.

    These are the tensors at the same place of the other states. Everything else is that of the first state.
    """
    first = states[0]
    if isinstance(first, Tensor):
        return function(*states)
    if isinstance(first, Mapping):
        return {name: map_tensors(function, *(state[name] for state in states)) for name in first}
    if isinstance(first, list):
        return [map_tensors(function, *parts) for parts in zip(*states, strict=True)]
    return first
