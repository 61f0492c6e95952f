"""Moments of a trajectory as critics see them: before each step, after the last, where streams were cut."""

from collections.abc import Callable
from dataclasses import dataclass
from operator import attrgetter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from headway.contracts import Trajectory
from headway_algos.batches.hidden_states import HiddenStates
from headway_algos.batches.layout import Truncations, last_known_masks, zero_where_absent


@dataclass(frozen=True)
class CriticBatch:
    """M moments of C copies. Rows of absent agents are 0, and all actions are allowed to them.

    There are two presences, which differ right after streams ended: at an episode's end agents that were away
    or gone are marked as well. Their last observation serves their own value, and no value of others."""

    observations: NDArray[np.float32]
    """(M, C, N, D)"""
    states: NDArray[np.float32]
    """(M, C, S)"""
    present: NDArray[np.bool_]
    """(M, C, N): the agent has an observation."""
    in_joint: NDArray[np.bool_]
    """(M, C, N): the agent is part of joint inputs (concatenated observations, others' actions)."""
    masks: NDArray[np.bool_] | None
    """(M, C, N, A), or None where the environment has none."""
    actions: NDArray[Any] | None = None
    """(M, C, N) or (M, C, N, size): what was chosen; None where nothing was, or nobody asks."""
    remembered: Callable[[HiddenStates], NDArray[Any]] = attrgetter("of_steps")
    """What was remembered at these moments, (M, C, W, size), of all that was along the trajectory."""

    @classmethod
    def of_steps(cls, trajectory: Trajectory) -> "CriticBatch":
        """The T steps, as the agents faced them, and what they chose."""
        alive = trajectory.alive[:-1]
        return cls(
            zero_where_absent(trajectory.observations[:-1], alive),
            trajectory.states[:-1],
            alive,
            alive,
            _allowed(trajectory.action_masks[:-1], alive),
            zero_where_absent(trajectory.actions, alive),
        )

    @classmethod
    def after_the_last_step(cls, trajectory: Trajectory) -> "CriticBatch":
        """The one moment that nobody has acted on yet."""
        alive = trajectory.alive[-1:]
        return cls(
            zero_where_absent(trajectory.observations[-1:], alive),
            trajectory.states[-1:],
            alive,
            alive,
            _allowed(trajectory.action_masks[-1:], alive),
            remembered=attrgetter("after_the_last_step"),
        )

    @classmethod
    def after_endings(cls, trajectory: Trajectory, endings: Truncations) -> "CriticBatch":
        """F moments of R copies, right after the step of each ending: final observations and states where
        they are valid, the next ones of agents that go on. An agent whose stream ended is in the joint inputs
        if it was alive before the step and did not terminate by it.
        """
        ended = endings.take(trajectory.terminated | trajectory.truncated)
        alive, next_alive = endings.take(trajectory.alive[:-1]), endings.take(trajectory.alive[1:])
        in_joint = np.where(ended, alive & ~endings.take(trajectory.terminated), next_alive)
        observations = np.where(
            ended[..., None],
            endings.take(trajectory.final_observations),
            endings.take(trajectory.observations[1:]),
        )
        everyone = ended.all(axis=-1, keepdims=True)
        states = np.where(
            everyone, endings.take(trajectory.final_states), endings.take(trajectory.states[1:])
        )
        present, masks = ended | next_alive, None
        if len(trajectory.action_masks):
            until = endings.steps[..., None], endings.copies[..., None], np.arange(ended.shape[2])
            before = last_known_masks(trajectory, until)
            after = endings.take(trajectory.action_masks[1:]) | ~next_alive[..., None]
            masks = np.where(ended[..., None], before, after)
        return cls(
            zero_where_absent(observations, present),
            states,
            present,
            in_joint,
            masks,
            remembered=lambda memories: memories.after_endings(endings),
        )


def _allowed(masks: NDArray[np.bool_], alive: NDArray[np.bool_]) -> NDArray[np.bool_] | None:
    return masks | ~alive[..., None] if len(masks) else None
