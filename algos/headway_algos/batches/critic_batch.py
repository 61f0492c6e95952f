"""Inputs of critics at time points of a trajectory: before each step, after the last, at truncations."""

from collections.abc import Callable
from dataclasses import dataclass
from operator import attrgetter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from headway.contracts import Trajectory
from headway_algos.batches.hidden_states import HiddenStates
from headway_algos.batches.layout import zero_where_absent
from headway_algos.batches.stream_ends import Truncations, last_known_masks


@dataclass(frozen=True)
class CriticBatch:
    """C copies at M time points. Rows of absent agents are 0, and their action masks allow every action.

    `present` and `in_joint` differ only right after a truncation: an agent whose stream has just ended still
    has a value to bootstrap from, but is left out of other agents' inputs if it terminated or was absent.
    """

    observations: NDArray[np.float32]
    """(M, C, N, D)"""
    states: NDArray[np.float32]
    """(M, C, S)"""
    present: NDArray[np.bool_]
    """(M, C, N): the agent is alive, or its stream has just ended."""
    in_joint: NDArray[np.bool_]
    """(M, C, N): the agent is part of joint inputs (concatenated observations, the others' actions)."""
    masks: NDArray[np.bool_] | None
    """(M, C, N, A) action masks, or None if the environment has none."""
    actions: NDArray[Any] | None = None
    """(M, C, N) for Discrete, (M, C, N, choices) for MultiDiscrete, (M, C, N, size) for Box; None if no
    actions were taken or none are needed."""
    decides: NDArray[np.bool_] | None = None
    """(M, C, N): the environment used the agent's action; None unless M are the steps of a trajectory."""
    ends: NDArray[np.bool_] | None = None
    """(M, C, N): the agent's stream ends with the step; None like `decides`."""
    select_hidden: Callable[[HiddenStates], NDArray[Any]] = attrgetter("of_steps")
    """Selects the hidden states (M, C, W, size) at these time points from those of the trajectory."""

    @classmethod
    def of_steps(cls, trajectory: Trajectory) -> "CriticBatch":
        """Return the observations before each of the T steps, with the actions taken."""
        alive = trajectory.alive[:-1]
        return cls(
            zero_where_absent(trajectory.observations[:-1], alive),
            trajectory.states[:-1],
            alive,
            alive,
            _allowed(trajectory.action_masks[:-1], alive),
            zero_where_absent(trajectory.actions, alive),
            trajectory.acting & alive,
            trajectory.terminated | trajectory.truncated,
        )

    @classmethod
    def after_last_step(cls, trajectory: Trajectory) -> "CriticBatch":
        """Return the observations after the last step, without actions."""
        alive = trajectory.alive[-1:]
        return cls(
            zero_where_absent(trajectory.observations[-1:], alive),
            trajectory.states[-1:],
            alive,
            alive,
            _allowed(trajectory.action_masks[-1:], alive),
            select_hidden=attrgetter("after_last_step"),
        )

    @classmethod
    def after_truncations(cls, trajectory: Trajectory, truncations: Truncations) -> "CriticBatch":
        """Return the observations right after each truncation, as F time points of R copies.

        Agents whose stream ended contribute their final observation, others the next one; the state is the
        final one if the episode ended. No mask is recorded with a final observation, so the last known mask
        is used. An agent whose stream ended is part of joint inputs if it was alive before the step and did
        not terminate with it.
        """
        ended = truncations.take(trajectory.terminated | trajectory.truncated)
        alive, next_alive = truncations.take(trajectory.alive[:-1]), truncations.take(trajectory.alive[1:])
        in_joint = np.where(ended, alive & ~truncations.take(trajectory.terminated), next_alive)
        observations = np.where(
            ended[..., None],
            truncations.take(trajectory.final_observations),
            truncations.take(trajectory.observations[1:]),
        )
        episode_ended = truncations.take(trajectory.episode_ended)[..., None]
        states = np.where(
            episode_ended, truncations.take(trajectory.final_states), truncations.take(trajectory.states[1:])
        )
        present, masks = ended | next_alive, None
        if len(trajectory.action_masks):
            until = truncations.steps[..., None], truncations.copies[..., None], np.arange(ended.shape[2])
            before = last_known_masks(trajectory, until)
            after = truncations.take(trajectory.action_masks[1:]) | ~next_alive[..., None]
            masks = np.where(ended[..., None], before, after)
        return cls(
            zero_where_absent(observations, present),
            states,
            present,
            in_joint,
            masks,
            select_hidden=lambda hidden_states: hidden_states.after_truncations(truncations),
        )


def _allowed(masks: NDArray[np.bool_], alive: NDArray[np.bool_]) -> NDArray[np.bool_] | None:
    return masks | ~alive[..., None] if len(masks) else None
