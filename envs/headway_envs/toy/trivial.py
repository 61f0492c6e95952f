"""Cheapest environment that can still be learnt, to measure the cost of everything around it.

Each agent observes four new random numbers per step; the right action is the index of the largest of the
first three. All agents receive the share of agents that were right.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from headway.contracts import (
    BatchedEnv,
    Discrete,
    EnvSpec,
    ObservationFeature,
    Observations,
    StepResult,
    generator,
)
from headway.contracts.checks import require_at_least
from headway_envs.toy.toy_env import ToyEnv

OBSERVATION_SIZE = 4
NUM_ACTIONS = 3


@dataclass(frozen=True)
class TrivialConfig:
    """Size of the task. A perfect episode returns `steps` to every agent, random play a third of that."""

    agents: int = 10
    """Number of agents."""
    steps: int = 200
    """Number of steps after which an episode is truncated."""

    def __post_init__(self) -> None:
        require_at_least(1, agents=self.agents, steps=self.steps)


def episode_generator(seed: int, episode: int) -> np.random.Generator:
    """Return the generator of an episode's draws, for the batched and the dictionary form."""
    return generator(seed, "trivial", episode)


def agent_names(count: int) -> tuple[str, ...]:
    """Return the names agent_0, agent_1, ..."""
    return tuple(f"agent_{index}" for index in range(count))


class Trivial(ToyEnv):
    """The cheapest environment in C copies, all at the same step: all episodes have the same length."""

    def __init__(self, config: TrivialConfig, copies: int) -> None:
        self._steps, agents = config.steps, config.agents
        spec = EnvSpec(
            name="trivial",
            agents=agent_names(agents),
            observation_size=OBSERVATION_SIZE,
            action_space=Discrete(NUM_ACTIONS),
            state_size=agents * OBSERVATION_SIZE,
            shared_reward=True,
            metrics=("accuracy",),
            observation_features=(
                *(
                    ObservationFeature(f"number_{action}", "random, -1 to 1; the largest names the action")
                    for action in range(NUM_ACTIONS)
                ),
                ObservationFeature("distraction", "random, -1 to 1, and of no use"),
            ),
            snapshots=True,
        )
        super().__init__(spec, copies)
        self._table = np.zeros((config.steps + 1, copies, agents, OBSERVATION_SIZE), dtype=np.float32)
        self._right = np.zeros((config.steps + 1, copies, agents), dtype=np.int64)
        self._matches = np.zeros((copies, agents), dtype=np.bool_)
        self._counts = np.zeros(copies, dtype=np.int64)
        self._total = np.zeros(copies, dtype=np.int64)

    def step(self, actions: NDArray[Any]) -> tuple[StepResult, Observations]:
        outcome = self._outcome
        if self._step == 0:
            outcome.truncated.fill(False)
            outcome.episode_ended.fill(False)
        np.equal(actions, self._right[self._step], out=self._matches)
        np.add.reduce(self._matches, axis=1, dtype=np.int64, out=self._counts)
        np.divide(self._counts[:, None], self._spec.num_agents, out=outcome.rewards, casting="unsafe")
        self._total += self._counts
        self._step += 1
        if self._step == self._steps:
            self._end()
        return outcome, self._show()

    def snapshot(self) -> tuple[NDArray[np.uint64], int, int, NDArray[np.int64]]:
        return self._seeds.copy(), self._episode, self._step, self._total.copy()

    def restore(self, snapshot: tuple[NDArray[np.uint64], int, int, NDArray[np.int64]]) -> Observations:
        seeds, episode, step, total = snapshot
        self._seeds[:] = seeds
        self._begin(episode)
        self._step = step
        self._total[:] = total
        self._outcome.truncated.fill(False)
        self._outcome.episode_ended.fill(False)
        return self._show()

    def _begin(self, episode: int) -> None:
        self._episode, self._step = episode, 0
        self._total.fill(0)
        shape = (self._steps + 1, self._spec.num_agents, OBSERVATION_SIZE)
        for copy, seed in enumerate(self._seeds):
            drawn = episode_generator(int(seed), episode).random(shape, dtype=np.float32)
            self._table[:, copy] = drawn
        self._table *= 2
        self._table -= 1
        first, second, third = (self._table[..., index] for index in range(NUM_ACTIONS))
        # Equal to argmax, ties to the lower index, and several times faster on so short an axis.
        np.copyto(self._right, second > first)
        self._right[third > np.maximum(first, second)] = 2

    def _end(self) -> None:
        outcome, last = self._outcome, self._table[self._steps]
        outcome.truncated.fill(True)
        outcome.episode_ended.fill(True)
        outcome.final_observations[:] = last
        outcome.final_states[:] = last.reshape(self.num_copies, -1)
        outcome.metrics[:, 0] = self._total / (self._steps * self._spec.num_agents)
        self._begin(self._episode + 1)

    def _show(self) -> Observations:
        observations = self._table[self._step]
        return Observations(observations, observations.reshape(self.num_copies, -1), self._observed.alive)


@dataclass(frozen=True)
class OptimalTrivial:
    """Takes the right action at every step: returns `steps`."""

    config: TrivialConfig

    def act(self, env: BatchedEnv, observed: Observations) -> NDArray[np.int64]:
        """Return the actions (C, N)."""
        actions: NDArray[np.int64] = np.argmax(observed.observations[..., :NUM_ACTIONS], axis=-1)
        return actions
