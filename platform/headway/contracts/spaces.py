"""Action spaces. All agents of an environment have the same one."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Discrete:
    """One of `n` actions, numbered 0 to n - 1. Action arrays are int64 (..., N)."""

    n: int
    """Number of actions, at least 1."""


@dataclass(frozen=True)
class MultiDiscrete:
    """Several choices at once, choice i one of `nvec[i]` options. Action arrays are int64 (..., N,
    len(nvec))."""

    nvec: tuple[int, ...]
    """Number of options per choice."""


@dataclass(frozen=True)
class Box:
    """A real vector within bounds. Action arrays are float32 (..., N, size).

    Sampled actions may lie outside the bounds: the environment clips them.
    """

    low: tuple[float, ...]
    """Lower bound per component; -inf: none."""
    high: tuple[float, ...]
    """Upper bound per component; inf: none."""

    @property
    def size(self) -> int:
        """Number of components of an action."""
        return len(self.low)


ActionSpace = Discrete | MultiDiscrete | Box
