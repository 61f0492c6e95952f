"""The one record that rollout workers write and learners read."""

from dataclasses import dataclass, fields
from math import prod
from typing import Any, Self

import numpy as np
from numpy.typing import DTypeLike, NDArray

from headway.contracts.environment import EnvSpec
from headway.contracts.spaces import Box, Discrete, MultiDiscrete

_ALIGNMENT = 64


@dataclass(frozen=True)
class TrajectoryLayout:
    """Shapes and types of a trajectory's arrays, and their places in one block of memory."""

    spec: EnvSpec
    steps: int
    """T"""
    copies: int
    """C, over all replicas."""
    hidden_size: int = 0
    """M: numbers that each agent remembers; 0: none."""

    @property
    def arrays(self) -> dict[str, tuple[tuple[int, ...], DTypeLike]]:
        """Shape and type of every field of `Trajectory`, in order."""
        spec, t, c, n = self.spec, self.steps, self.copies, self.spec.num_agents
        d, s, m = spec.observation_size, spec.state_size, self.hidden_size
        remembered = 1 if m else 0
        match spec.action_space:
            case Discrete(n=num_actions):
                actions: tuple[tuple[int, ...], DTypeLike] = (t, c, n), np.int64
            case MultiDiscrete(nvec=nvec):
                actions, num_actions = ((t, c, n, len(nvec)), np.int64), sum(nvec)
            case Box(low=low):
                actions, num_actions = ((t, c, n, len(low)), np.float32), 0
        return {
            "observations": ((t + 1, c, n, d), np.float32),
            "states": ((t + 1, c, s), np.float32),
            "alive": ((t + 1, c, n), np.bool_),
            "action_masks": ((t + 1 if spec.has_action_mask else 0, c, n, num_actions), np.bool_),
            "actions": actions,
            "log_probs": ((t, c, n), np.float64),
            "rewards": ((t, c, n), np.float32),
            "terminated": ((t, c, n), np.bool_),
            "truncated": ((t, c, n), np.bool_),
            "acting": ((t, c, n), np.bool_),
            "final_observations": ((t, c, n, d), np.float32),
            "final_states": ((t, c, s), np.float32),
            "memory": ((remembered, c, n, m), np.float64),
            "begins": ((remembered, c, n), np.bool_),
        }

    @property
    def nbytes(self) -> int:
        """Size in bytes of one block that holds every array."""
        return sum(_padded(shape, dtype) for shape, dtype in self.arrays.values())


def _padded(shape: tuple[int, ...], dtype: DTypeLike) -> int:
    return aligned(prod(shape) * np.dtype(dtype).itemsize)


def aligned(nbytes: int) -> int:
    """That many bytes, rounded up so that an array of any type may lie behind them."""
    return -(-nbytes // _ALIGNMENT) * _ALIGNMENT


@dataclass(frozen=True, slots=True)
class Trajectory:
    """T steps of C copies, a struct of arrays. Row t of `observations`, `states`, `alive` and
    `action_masks` is what was faced before action t; row T is what comes after the last step."""

    observations: NDArray[np.float32]
    """(T + 1, C, N, D)"""
    states: NDArray[np.float32]
    """(T + 1, C, S)"""
    alive: NDArray[np.bool_]
    """(T + 1, C, N)"""
    action_masks: NDArray[np.bool_]
    """(T + 1, C, N, A); first axis 0 where the environment has no masks."""
    actions: NDArray[Any]
    """(T, C, N) int64, or (T, C, N, size)"""
    log_probs: NDArray[np.float64]
    """(T, C, N): the worker's, at the parameters that acted."""
    rewards: NDArray[np.float32]
    """(T, C, N)"""
    terminated: NDArray[np.bool_]
    """(T, C, N)"""
    truncated: NDArray[np.bool_]
    """(T, C, N)"""
    acting: NDArray[np.bool_]
    """(T, C, N)"""
    final_observations: NDArray[np.float32]
    """(T, C, N, D): valid where terminated or truncated."""
    final_states: NDArray[np.float32]
    """(T, C, S): valid where the copy's episode ended."""
    memory: NDArray[np.float64]
    """(1, C, N, M): what agents remembered before row 0; first axis 0 for policies without memory."""
    begins: NDArray[np.bool_]
    """(1, C, N): the agent's stream begins with row 0, whatever was before; first axis as `memory`'s."""

    @classmethod
    def over(cls, buffer: Any, layout: TrajectoryLayout) -> Self:  # noqa: ANN401 - anything with a buffer
        """A trajectory whose arrays lie in `buffer`, which holds at least `layout.nbytes` bytes."""
        arrays, offset = {}, 0
        for name, (shape, dtype) in layout.arrays.items():
            arrays[name] = np.frombuffer(buffer, dtype, prod(shape), offset).reshape(shape)
            offset += _padded(shape, dtype)
        return cls(**arrays)

    @classmethod
    def allocate(cls, layout: TrajectoryLayout) -> Self:
        """A trajectory of its own memory, filled with zeros."""
        return cls.over(bytearray(layout.nbytes), layout)

    def of_copies(self, first: int, count: int) -> Self:
        """A view of the copies first to first + count - 1."""
        return type(self)(*(getattr(self, field.name)[:, first : first + count] for field in fields(self)))

    def of_first_agents(self, count: int) -> Self:
        """A view of the first agents."""
        arrays = {field.name: getattr(self, field.name) for field in fields(self)}
        of_copies = {"states", "final_states"}
        return type(self)(**{n: a if n in of_copies else a[:, :, :count] for n, a in arrays.items()})
