"""One-step cooperative matrix game: two agents, a shared payoff, and a trap next to the best payoff.

The default is the climbing game of Claus and Boutilier, "The Dynamics of Reinforcement Learning in
Cooperative Multiagent Systems" (AAAI 1998): the payoff 11 is next to -30, so exploring learners drift to 5 or
7.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from headway.contracts import BatchedEnv, Discrete, EnvSpec, ObservationFeature, Observations, StepResult
from headway.contracts.checks import require_key
from headway_envs.toy.toy_env import ToyEnv

CLIMBING = ((11.0, -30.0, 0.0), (-30.0, 7.0, 6.0), (0.0, 0.0, 5.0))
NUM_AGENTS = 2


@dataclass(frozen=True)
class MatrixConfig:
    """Payoffs of the game. The best return of an episode is the largest payoff."""

    payoff: tuple[tuple[float, ...], ...] = CLIMBING
    """Square payoff matrix: rows are the first agent's choices, columns the second's."""

    def __post_init__(self) -> None:
        size = len(self.payoff)
        square = size >= 1 and all(len(row) == size for row in self.payoff)
        lengths = f"not rows of {[len(row) for row in self.payoff]}"
        require_key(square, "payoff", f"must have as many columns as rows, {lengths}")
        require_key(bool(np.isfinite(self.payoff).all()), "payoff", "must hold finite numbers only")


class Matrix(ToyEnv):
    """The matrix game in C copies.

    Each agent observes its index (one-hot, D = 2); every step ends the episode.
    """

    def __init__(self, config: MatrixConfig, copies: int) -> None:
        self._payoff = np.array(config.payoff, dtype=np.float64)
        spec = EnvSpec(
            name="matrix",
            agents=("row", "column"),
            observation_size=NUM_AGENTS,
            action_space=Discrete(len(self._payoff)),
            state_size=1,
            shared_reward=True,
            metrics=("optimal",),
            observation_features=(
                ObservationFeature("row", "1 for the agent `row`, else 0"),
                ObservationFeature("column", "1 for the agent `column`, else 0"),
            ),
            snapshots=True,
        )
        super().__init__(spec, copies)
        observed, outcome = self._observed, self._outcome
        observed.observations[:] = outcome.final_observations[:] = np.eye(NUM_AGENTS, dtype=np.float32)
        observed.states.fill(1)
        outcome.final_states.fill(1)
        outcome.terminated.fill(True)
        outcome.episode_ended.fill(True)

    @property
    def best(self) -> tuple[int, int]:
        """Row and column of the largest payoff."""
        row, column = np.unravel_index(int(np.argmax(self._payoff)), self._payoff.shape)
        return int(row), int(column)

    def step(self, actions: NDArray[Any]) -> tuple[StepResult, Observations]:
        payoff = self._payoff[actions[:, 0], actions[:, 1]]
        self._outcome.rewards[:] = payoff[:, None]
        self._outcome.metrics[:, 0] = payoff == self._payoff.max()
        return self._outcome, self._observed

    def snapshot(self) -> None:
        """Return None: one-step episodes have no state."""

    def restore(self, snapshot: None) -> Observations:
        return self._observed

    def _begin(self, episode: int) -> None:
        """Do nothing: nothing is random, and an episode has no state."""

    def _show(self) -> Observations:
        return self._observed


@dataclass(frozen=True)
class OptimalMatrix:
    """Plays the joint action with the largest payoff."""

    config: MatrixConfig

    def act(self, env: BatchedEnv, observed: Observations) -> NDArray[np.int64]:
        """Return the actions (C, 2). Raises TypeError for any other environment."""
        if not isinstance(env, Matrix):
            raise TypeError("the optimal rule of 'matrix' reads the payoff of a Matrix")
        return np.tile(np.array(env.best, dtype=np.int64), (env.num_copies, 1))
