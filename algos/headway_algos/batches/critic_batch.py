"""Moments of a trajectory as critics see them: before each step, after the last, where streams were cut."""

from collections.abc import Callable
from dataclasses import dataclass
from operator import attrgetter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from headway.contracts import Trajectory
from headway_algos.batches.hidden_states import HiddenStates
from headway_algos.batches.layout import Truncations, zero_where_absent


@dataclass(frozen=True)
class CriticBatch:
    """M moments of C copies. Rows of absent agents are 0, and all actions are allowed to them."""

    observations: NDArray[np.float32]
    """(M, C, N, D)"""
    states: NDArray[np.float32]
    """(M, C, S)"""
    present: NDArray[np.bool_]
    """(M, C, N)"""
    masks: NDArray[np.bool_] | None
    """(M, C, N, A), or None where the environment has none."""
    actions: NDArray[Any] | None = None
    """(M, C, N) or (M, C, N, size): what was chosen; None where nothing was, or nobody asks."""
    select_hidden: Callable[[HiddenStates], NDArray[Any]] = attrgetter("of_steps")
    """What was remembered at these moments, (M, C, W, size), of all that was along the trajectory."""

    @classmethod
    def of_steps(cls, trajectory: Trajectory) -> "CriticBatch":
        """The T steps, as the agents faced them, and what they chose."""
        alive = trajectory.alive[:-1]
        return cls(
            zero_where_absent(trajectory.observations[:-1], alive),
            trajectory.states[:-1],
            alive,
            _allowed(trajectory.action_masks[:-1], alive),
            zero_where_absent(trajectory.actions, alive),
        )

    @classmethod
    def after_last_step(cls, trajectory: Trajectory) -> "CriticBatch":
        """The one moment that nobody has acted on yet."""
        alive = trajectory.alive[-1:]
        return cls(
            zero_where_absent(trajectory.observations[-1:], alive),
            trajectory.states[-1:],
            alive,
            _allowed(trajectory.action_masks[-1:], alive),
            select_hidden=attrgetter("after_the_last_step"),
        )

    @classmethod
    def after_truncations(cls, trajectory: Trajectory, truncations: Truncations) -> "CriticBatch":
        """F moments of R copies, right after the step of each ending: final observations and states where
        they are valid, what came next for those who went on.

        No mask is recorded for a final observation: those of the step before are the nearest known.
        """
        ended = truncations.take(trajectory.terminated | trajectory.truncated)
        next_alive = truncations.take(trajectory.alive[1:])
        observations = np.where(
            ended[..., None],
            truncations.take(trajectory.final_observations),
            truncations.take(trajectory.observations[1:]),
        )
        everyone = ended.all(axis=-1, keepdims=True)
        states = np.where(
            everyone, truncations.take(trajectory.final_states), truncations.take(trajectory.states[1:])
        )
        present, masks = ended | next_alive, None
        if len(trajectory.action_masks):
            before = (
                truncations.take(trajectory.action_masks[:-1])
                | ~truncations.take(trajectory.alive)[..., None]
            )
            after = truncations.take(trajectory.action_masks[1:]) | ~next_alive[..., None]
            masks = np.where(ended[..., None], before, after)
        return cls(
            zero_where_absent(observations, present),
            states,
            present,
            masks,
            select_hidden=lambda hidden_states: hidden_states.after_truncations(truncations),
        )


def _allowed(masks: NDArray[np.bool_], alive: NDArray[np.bool_]) -> NDArray[np.bool_] | None:
    return masks | ~alive[..., None] if len(masks) else None
