"""Agents follow a moving target in the plane: linear dynamics, quadratic cost, optimum in closed form.

The target moves at a constant velocity v, drawn per episode. Agent i has offset e_i = target - position and
moves by its action a: e' = e + v - a + w, with noise w. Its cost per step is |e'|^2 + effort |a|^2, so the
best policy is that of a linear-quadratic regulator (Bertsekas, "Dynamic Programming and Optimal Control",
vol. 1, section 3.1), whose actions stay within the bounds of the action space.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from headway.contracts import (
    BatchedEnv,
    Box,
    EnvSpec,
    ObservationFeature,
    Observations,
    StepResult,
    generator,
)
from headway.contracts.checks import require_at_least, require_value
from headway_envs.toy.toy_env import ToyEnv

DIMENSIONS = 2
SPEED = 0.1
"""Bound on each component of the target's velocity, per step."""


@dataclass(frozen=True)
class TrackingConfig:
    """Size and costs. Each agent receives its own reward."""

    agents: int = 3
    """Number of agents."""
    steps: int = 50
    """Number of steps after which an episode is truncated."""
    effort: float = 0.1
    """Weight of the squared length of the action in the cost; that of the squared distance is 1."""
    noise: float = 0.02
    """Bound on the noise w; each component is uniform within it."""

    def __post_init__(self) -> None:
        require_at_least(1, agents=self.agents, steps=self.steps)
        require_value(self, "effort", 0 <= self.effort <= 10, "must be within 0 and 10")
        require_value(self, "noise", 0 <= self.noise <= 0.1, "must be within 0 and 0.1")


def regulator(config: TrackingConfig) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the optimal policy and its cost per component of the plane, by the Riccati recursion.

    Gains (T, 2) and values (T + 1, 3): after t steps the best action is gains[t] @ (e, v), and the expected
    cost-to-go is p e^2 + 2 q e v + s v^2 with p, q, s = values[t], plus the cost of noise, (1 + p) noise^2 /
    3 per step with p of the next step.
    """
    gains = np.zeros((config.steps, 2))
    values = np.zeros((config.steps + 1, 3))
    for t in reversed(range(config.steps)):
        p, q, s = values[t + 1]
        # With the next offset u = e + v - a, the cost is (1 + p) u^2 + 2 q u v + s v^2 + effort a^2.
        weight = 1 + p + config.effort
        gains[t] = (1 + p) / weight, (1 + p + q) / weight
        # e + v - a and a are linear in (e, v): their coefficients give the new quadratic form.
        rest = np.array([1.0, 1.0]) - gains[t]
        velocity = np.array([0.0, 1.0])
        form = (
            (1 + p) * np.outer(rest, rest)
            + q * (np.outer(rest, velocity) + np.outer(velocity, rest))
            + s * np.outer(velocity, velocity)
            + config.effort * np.outer(gains[t], gains[t])
        )
        values[t] = form[0, 0], form[0, 1], form[1, 1]
    return gains, values


class Tracking(ToyEnv):
    """The tracking task in C copies.

    Agents observe (e, v), D = 4, and act within [-2, 2]; the state holds all e, then v.
    """

    def __init__(self, config: TrackingConfig, copies: int) -> None:
        self._config, n = config, config.agents
        spec = EnvSpec(
            name="tracking",
            agents=tuple(f"agent_{index}" for index in range(n)),
            observation_size=2 * DIMENSIONS,
            action_space=Box((-2.0,) * DIMENSIONS, (2.0,) * DIMENSIONS),
            state_size=(n + 1) * DIMENSIONS,
            metrics=("distance", "effort"),
            observation_features=(
                *(ObservationFeature(f"offset_{axis}", "target minus position") for axis in "xy"),
                *(
                    ObservationFeature(f"velocity_{axis}", "velocity of the target, per step")
                    for axis in "xy"
                ),
            ),
            snapshots=True,
        )
        super().__init__(spec, copies)
        self._offset = np.zeros((copies, n, DIMENSIONS))
        self._velocity = np.zeros((copies, 1, DIMENSIONS))
        self._noise = np.zeros((config.steps, copies, n, DIMENSIONS))
        self._sums = np.zeros((copies, 2))

    @property
    def steps_taken(self) -> int:
        """Number of steps taken in the current episode, the same for all copies."""
        return self._step

    def step(self, actions: NDArray[Any]) -> tuple[StepResult, Observations]:
        outcome = self._outcome
        moves = np.clip(actions.astype(np.float64), -2.0, 2.0)
        self._offset += self._velocity - moves + self._noise[self._step]
        distance = (self._offset**2).sum(axis=-1)
        effort = (moves**2).sum(axis=-1)
        outcome.rewards[:] = -distance - self._config.effort * effort
        self._sums += np.stack([distance.mean(axis=1), effort.mean(axis=1)], axis=1)
        self._step += 1
        ended = self._step == self._config.steps
        outcome.truncated.fill(ended)
        outcome.episode_ended.fill(ended)
        if ended:
            last = self._show()
            outcome.final_observations[:] = last.observations
            outcome.final_states[:] = last.states
            outcome.metrics[:] = self._sums / self._step
            self._begin(self._episode + 1)
        return outcome, self._show()

    def snapshot(self) -> dict[str, Any]:
        return {
            "seeds": self._seeds.copy(),
            "episode": self._episode,
            "step": self._step,
            "offset": self._offset.copy(),
            "sums": self._sums.copy(),
        }

    def restore(self, snapshot: dict[str, Any]) -> Observations:
        self._seeds[:] = snapshot["seeds"]
        self._begin(snapshot["episode"])
        self._step = snapshot["step"]
        self._offset[:] = snapshot["offset"]
        self._sums[:] = snapshot["sums"]
        return self._show()

    def _begin(self, episode: int) -> None:
        self._episode, self._step = episode, 0
        self._sums.fill(0)
        bound = self._config.noise
        for copy, seed in enumerate(self._seeds):
            draw = generator(int(seed), "tracking", episode)
            self._offset[copy] = draw.uniform(-1, 1, self._offset[copy].shape)
            self._velocity[copy] = draw.uniform(-SPEED, SPEED, (1, DIMENSIONS))
            self._noise[:, copy] = draw.uniform(-bound, bound, self._noise[:, copy].shape)

    def _show(self) -> Observations:
        observed, n = self._observed, self._spec.num_agents
        observed.observations[..., :DIMENSIONS] = self._offset
        observed.observations[..., DIMENSIONS:] = self._velocity
        observed.states[:, : n * DIMENSIONS] = self._offset.reshape(self.num_copies, -1)
        observed.states[:, n * DIMENSIONS :] = self._velocity[:, 0]
        return observed


class OptimalTracking:
    """Finite-horizon linear-quadratic regulator."""

    def __init__(self, config: TrackingConfig) -> None:
        self._gains, _ = regulator(config)

    def act(self, env: BatchedEnv, observed: Observations) -> NDArray[np.float32]:
        """Return the actions (C, N, 2). Raises TypeError for any other environment."""
        if not isinstance(env, Tracking):
            raise TypeError("the optimal rule of 'tracking' reads the step of a Tracking")
        on_offset, on_velocity = self._gains[env.steps_taken]
        offset, velocity = np.split(observed.observations, 2, axis=-1)
        actions: NDArray[np.float32] = (on_offset * offset + on_velocity * velocity).astype(np.float32)
        return actions
