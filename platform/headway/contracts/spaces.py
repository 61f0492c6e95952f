"""The kinds of action an agent can take; every agent of an environment has the same."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Discrete:
    """One of `n` actions, 0 to n - 1. Arrays of actions are int64 of shape (..., N)."""

    n: int


@dataclass(frozen=True)
class MultiDiscrete:
    """One choice from each of several lists, of lengths `nvec`. Actions are int64 (..., N, len(nvec))."""

    nvec: tuple[int, ...]


@dataclass(frozen=True)
class Box:
    """A vector within bounds. Actions are float32 of shape (..., N, size); the environment clips them."""

    low: tuple[float, ...]
    high: tuple[float, ...]

    @property
    def size(self) -> int:
        """Number of components of an action."""
        return len(self.low)


ActionSpace = Discrete | MultiDiscrete | Box
