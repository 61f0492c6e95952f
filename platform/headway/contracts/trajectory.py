"""The trajectory: the one record that rollout workers write and learners read."""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from math import prod
from typing import Any, Self

import numpy as np
from numpy.typing import DTypeLike, NDArray

from headway.contracts.environment import EnvSpec

ArrayShapes = Mapping[str, tuple[tuple[int, ...], DTypeLike]]
"""Shape and dtype of arrays by name."""
_ALIGNMENT = 64  # bytes, a cache line


def aligned(nbytes: int) -> int:
    """Round a number of bytes up to a multiple at which an array of any dtype may start."""
    return -(-nbytes // _ALIGNMENT) * _ALIGNMENT


def block_nbytes(shapes: ArrayShapes) -> int:
    """Return the size in bytes of the buffer that `arrays_in` needs."""
    return sum(aligned(prod(shape) * np.dtype(dtype).itemsize) for shape, dtype in shapes.values())


def arrays_in(buffer: Any, shapes: ArrayShapes) -> dict[str, NDArray[Any]]:  # noqa: ANN401 - anything with a buffer
    """Return arrays by name that lie one after another in a buffer."""
    arrays: dict[str, NDArray[Any]] = {}
    offset = 0
    for name, (shape, dtype) in shapes.items():
        arrays[name] = np.frombuffer(buffer, dtype, prod(shape), offset).reshape(shape)
        offset += aligned(arrays[name].nbytes)
    return arrays


@dataclass(frozen=True)
class TrajectoryLayout:
    """Shapes and dtypes of a trajectory's arrays, and their offsets in one block of memory."""

    spec: EnvSpec
    """Environment that the trajectory is sampled from."""
    steps: int
    """T: steps per copy."""
    copies: int
    """C, copies of all replicas."""
    hidden_size: int = 0
    """M, components of an agent's hidden state; 0: the policy has no recurrence."""

    @property
    def arrays(self) -> dict[str, tuple[tuple[int, ...], DTypeLike]]:
        """Shape and dtype of every field of `Trajectory`, in field order."""
        spec, t, c, n = self.spec, self.steps, self.copies, self.spec.num_agents
        d, s, m = spec.observation_size, spec.state_size, self.hidden_size
        recurrent = 1 if m else 0
        space = spec.action_space
        return {
            "observations": ((t + 1, c, n, d), np.float32),
            "states": ((t + 1, c, s), np.float32),
            "alive": ((t + 1, c, n), np.bool_),
            "action_masks": ((t + 1 if spec.has_action_mask else 0, c, n, sum(space.options)), np.bool_),
            "actions": ((t, c, n, *space.shape), space.dtype),
            "log_probs": ((t, c, n), np.float64),
            "rewards": ((t, c, n), np.float32),
            "terminated": ((t, c, n), np.bool_),
            "truncated": ((t, c, n), np.bool_),
            "acting": ((t, c, n), np.bool_),
            "episode_ended": ((t, c), np.bool_),
            "final_observations": ((t, c, n, d), np.float32),
            "final_states": ((t, c, s), np.float32),
            "hidden_states": ((recurrent, c, n, m), np.float64),
            "begins": ((recurrent, c, n), np.bool_),
            "episode_begins": ((recurrent, c), np.bool_),
        }

    @property
    def nbytes(self) -> int:
        """Size in bytes of a block that holds every array."""
        return block_nbytes(self.arrays)


@dataclass(frozen=True, slots=True)
class Trajectory:
    """T steps of C copies as a struct of arrays.

    Row t of `observations`, `states`, `alive` and `action_masks` is what agents observed before action t; row
    T follows the last step. Row t of all other arrays is the action at step t and its result. Fields named as
    in `Observations` and `StepResult` have the same meaning, with a leading time axis.
    """

    observations: NDArray[np.float32]
    """(T + 1, C, N, D): rows of agents not alive are unspecified."""
    states: NDArray[np.float32]
    """(T + 1, C, S): global states."""
    alive: NDArray[np.bool_]
    """(T + 1, C, N): alive mask."""
    action_masks: NDArray[np.bool_]
    """(T + 1, C, N, A): action masks; first axis 0 if the environment has none."""
    actions: NDArray[Any]
    """Shape (T, C, N), int64, for Discrete; (T, C, N, choices), int64, for MultiDiscrete; (T, C, N, size),
    float32, for Box."""
    log_probs: NDArray[np.float64]
    """(T, C, N): log-probability of the action under the parameters that the worker sampled with."""
    rewards: NDArray[np.float32]
    """(T, C, N): rewards."""
    terminated: NDArray[np.bool_]
    """(T, C, N): the stream ended in a terminal state."""
    truncated: NDArray[np.bool_]
    """(T, C, N): the stream was cut off."""
    acting: NDArray[np.bool_]
    """(T, C, N): the environment used the action."""
    episode_ended: NDArray[np.bool_]
    """(T, C): the copy's episode ended with the step."""
    final_observations: NDArray[np.float32]
    """(T, C, N, D): last observation of a stream; valid where terminated or truncated."""
    final_states: NDArray[np.float32]
    """(T, C, S): last state of an episode; valid where the copy's episode ended."""
    hidden_states: NDArray[np.float64]
    """(1, C, N, M): hidden states before row 0; first axis 0 for policies without recurrence."""
    begins: NDArray[np.bool_]
    """(1, C, N): the agent's stream begins at row 0, so that nothing before it counts. First axis as in
    `hidden_states`."""
    episode_begins: NDArray[np.bool_]
    """(1, C): the copy's episode begins at row 0. First axis as in `hidden_states`."""

    @classmethod
    def from_buffer(cls, buffer: Any, layout: TrajectoryLayout) -> Self:  # noqa: ANN401 - anything with a buffer
        """Return a trajectory whose arrays lie in `buffer`, which holds at least `layout.nbytes` bytes."""
        return cls(**arrays_in(buffer, layout.arrays))

    @classmethod
    def allocate(cls, layout: TrajectoryLayout) -> Self:
        """Return a trajectory of zeros in newly allocated memory."""
        return cls.from_buffer(bytearray(layout.nbytes), layout)

    def of_copies(self, first: int, count: int) -> Self:
        """Return a view of copies first to first + count - 1."""
        return type(self)(*(getattr(self, field.name)[:, first : first + count] for field in fields(self)))

    def of_first_agents(self, count: int) -> Self:
        """Return a view of the first `count` agents."""
        arrays = {field.name: getattr(self, field.name) for field in fields(self)}
        of_copies = {"states", "final_states", "episode_ended", "episode_begins"}
        return type(self)(**{n: a if n in of_copies else a[:, :, :count] for n, a in arrays.items()})
