"""Action spaces. All agents of an environment have the same one."""

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

_LARGEST = 3.4028234663852886e38
"""Largest finite float32."""


@dataclass(frozen=True)
class Discrete:
    """One of `n` actions, numbered 0 to n - 1. Action arrays are int64 (..., N)."""

    n: int
    """Number of actions, at least 1."""
    dtype: ClassVar = np.int64
    shape: ClassVar[tuple[int, ...]] = ()
    """Shape of one agent's action."""

    @property
    def options(self) -> tuple[int, ...]:
        """Number of options of each choice."""
        return (self.n,)


@dataclass(frozen=True)
class MultiDiscrete:
    """Several choices at once, choice i one of `nvec[i]` options.

    Action arrays are int64 (..., N, len(nvec)).
    """

    nvec: tuple[int, ...]
    """Number of options per choice."""
    dtype: ClassVar = np.int64

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of one agent's action."""
        return (len(self.nvec),)

    @property
    def options(self) -> tuple[int, ...]:
        """Number of options of each choice."""
        return self.nvec

    def split(self, by_option: NDArray[Any]) -> list[NDArray[Any]]:
        """Split an array (..., sum of nvec), such as an action mask, into one (..., nvec[i]) per choice."""
        return np.split(by_option, np.cumsum(self.nvec)[:-1], axis=-1)


@dataclass(frozen=True)
class Box:
    """A real vector within bounds. Action arrays are float32 (..., N, size).

    Sampled actions may lie outside the bounds: the environment clips them.
    """

    low: tuple[float, ...]
    """Lower bound per component; -inf: none."""
    high: tuple[float, ...]
    """Upper bound per component; inf: none."""
    dtype: ClassVar = np.float32
    options: ClassVar[tuple[int, ...]] = ()
    """An action makes no choices."""

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of one agent's action."""
        return (self.size,)

    @property
    def size(self) -> int:
        """Number of components of an action."""
        return len(self.low)

    @property
    def bounded(self) -> bool:
        """Whether every component has two finite bounds."""
        # Many environments write "no bound" as the limits of float32, whose difference overflows.
        return all(high - low <= _LARGEST for low, high in zip(self.low, self.high, strict=True))

    @property
    def for_policies(self) -> "Box":
        """The box in the units of policies: [-1, 1] in every component with two finite, different bounds."""
        bounds = zip(self.low, self.high, strict=True)
        pairs = [(-1.0, 1.0) if 0 < high - low <= _LARGEST else (low, high) for low, high in bounds]
        return Box(tuple(low for low, _ in pairs), tuple(high for _, high in pairs))

    def scaling_to(self, other: "Box") -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return (scale, offset), each (size,), of the affine map from these bounds to those of `other`.

        Components with equal bounds in both stay as they are, bounded or not.
        """
        scale, offset = np.ones(self.size), np.zeros(self.size)
        bounds = zip(self.low, self.high, other.low, other.high, strict=True)
        for i, (low, high, new_low, new_high) in enumerate(bounds):
            if (low, high) != (new_low, new_high):
                scale[i] = (new_high - new_low) / (high - low)
                offset[i] = new_low - scale[i] * low
        return scale, offset


ActionSpace = Discrete | MultiDiscrete | Box
"""The action spaces that an environment may have."""


def allows_action(space: ActionSpace, masks: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return whether action masks (..., A) allow an action, (...): an option of every choice."""
    choices = space.split(masks) if isinstance(space, MultiDiscrete) else [masks]
    allowed: NDArray[np.bool_] = np.logical_and.reduce([choice.any(axis=-1) for choice in choices])
    return allowed
