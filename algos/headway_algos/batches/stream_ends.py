"""Ends of agents' streams in a trajectory: ends of returns, truncations, last known action masks."""

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from headway.contracts import EnvSpec, Trajectory


def last_known_masks(
    trajectory: Trajectory,
    until: tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]],
    earlier: NDArray[np.bool_] | Literal[True] = True,
) -> NDArray[np.bool_]:
    """Return each agent's action mask (..., A) at the last step at which it was alive.

    `until` are indices (steps, copies, agents), each (...): later steps are not searched. Where the agent was
    never alive, the mask is `earlier` (..., A). Needed because no mask is recorded with a final observation.
    """
    steps, copies, agents = until
    seen = np.where(trajectory.alive[:-1], np.arange(len(trajectory.rewards))[:, None, None], -1)
    last = np.maximum.accumulate(seen)[steps, copies, agents]
    return np.where(last[..., None] >= 0, trajectory.action_masks[last, copies, agents], earlier)


def return_ends(trajectory: Trajectory, spec: EnvSpec) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Return where agents' returns terminate and where they are truncated, (T, C, N) each.

    An agent's return ends with its stream. If rewards are shared, it is the team's return, which continues
    until the episode ends: the last action of an agent that leaves still affects its team. The episode was
    truncated unless all agents terminated.
    """
    terminated, truncated = trajectory.terminated, trajectory.truncated
    if not spec.teams:
        return terminated, truncated
    ended = trajectory.episode_ended[..., None]
    complete = ended & terminated.all(axis=2, keepdims=True)
    cut = ended & ~complete
    return np.broadcast_to(complete, terminated.shape), np.broadcast_to(cut, terminated.shape)


@dataclass(frozen=True)
class Truncations:
    """Time points at which streams were truncated, padded to F per replica."""

    steps: NDArray[np.int64]
    """(F, R): step of the truncation."""
    copies: NDArray[np.int64]
    """(F, R): copy, counted over all replicas."""
    used: NDArray[np.bool_]
    """(F, R): False for padding."""

    @classmethod
    def of(cls, trajectory: Trajectory, replicas: int) -> "Truncations":
        """Return all (step, copy) at which an agent was truncated and not terminated."""
        cut = (trajectory.truncated & ~trajectory.terminated).any(axis=2)
        steps, copies = np.nonzero(cut)
        replica_of = copies // (cut.shape[1] // replicas)
        lists = [np.flatnonzero(replica_of == r) for r in range(replicas)]
        width = max(len(positions) for positions in lists)
        table = np.stack(
            [np.pad(positions, (0, width - len(positions)), constant_values=-1) for positions in lists], 1
        )
        # Padding refers to the first truncation, so that indexing is valid; `used` tells them apart.
        safe = np.maximum(table, 0)
        if width == 0:
            return cls(table, table, table >= 0)
        return cls(steps[safe], copies[safe], table >= 0)

    def __len__(self) -> int:
        """F: time points per replica, padding included."""
        return len(self.steps)

    def take(self, array: NDArray[Any]) -> NDArray[Any]:
        """Return the rows of an array (T, C, ...) at the truncations, (F, R, ...)."""
        taken: NDArray[Any] = array[self.steps, self.copies]
        return taken

    def put(self, values: NDArray[Any], shape: tuple[int, ...]) -> NDArray[np.float64]:
        """Return zeros of `shape` (T, C, N) with `values` (F, R, N) inserted at the truncations."""
        result = np.zeros(shape)
        result[self.steps[self.used], self.copies[self.used]] = values[self.used]
        return result
