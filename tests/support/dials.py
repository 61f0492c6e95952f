"""A PettingZoo environment with MultiDiscrete actions and masks, whose optimum is a reward of 1 a step."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray
from pettingzoo import ParallelEnv

from headway.adapters.parallel_entry import parallel_entry

CHOICES = (2, 3)


class Dials(ParallelEnv[str, NDArray[np.float32], NDArray[np.int64]]):
    """Each agent sees, one-hot, a target for each of its dials, and is paid 1 if it sets all to them.

    Of the second dial one wrong position is forbidden, so that random play earns 1/4 a step.
    """

    metadata = {"name": "dials"}  # noqa: RUF012 - PettingZoo's own type

    def __init__(self, agents: int, steps: int) -> None:
        self.possible_agents = [f"agent_{i}" for i in range(agents)]
        self.agents: list[str] = []
        self.length = steps

    def observation_space(self, agent: str) -> spaces.Space[Any]:
        return spaces.Box(0, 1, (sum(CHOICES),), np.float32)

    def action_space(self, agent: str) -> spaces.Space[Any]:
        return spaces.MultiDiscrete(CHOICES)

    def reset(self, seed: int | None = None, options: object = None) -> tuple[Any, Any]:
        self.random, self.time = np.random.default_rng(seed), 0
        self.agents = list(self.possible_agents)
        return self._draw()

    def step(self, actions: dict[str, NDArray[np.int64]]) -> tuple[Any, ...]:
        self.time += 1
        rewards = {}
        for agent, action in actions.items():
            assert self.masks[agent][[action[0], CHOICES[0] + action[1]]].all(), "a forbidden option"
            rewards[agent] = float((action == self.targets[agent]).all())
        over = dict.fromkeys(self.agents, self.time == self.length)
        seen, infos = self._draw()
        if self.time == self.length:
            self.agents = []
        return seen, rewards, dict.fromkeys(over, False), over, infos

    def _draw(self) -> tuple[Any, Any]:
        """Draw targets and masks; return observations and infos."""
        self.targets = {agent: self.random.integers(0, CHOICES) for agent in self.agents}
        self.masks, seen = {}, {}
        for agent, target in self.targets.items():
            seen[agent] = np.concatenate([np.eye(n)[i] for n, i in zip(CHOICES, target, strict=True)])
            allowed = np.ones(sum(CHOICES), np.int8)
            allowed[CHOICES[0] + (target[1] + self.random.integers(1, 3)) % 3] = 0
            self.masks[agent] = allowed
        observations = {agent: row.astype(np.float32) for agent, row in seen.items()}
        return observations, {agent: {"action_mask": mask} for agent, mask in self.masks.items()}


@dataclass(frozen=True)
class DialsConfig:
    """Size."""

    agents: int = 2
    """Number of agents."""
    steps: int = 8
    """Steps of an episode, and its greatest return."""


def parallel_env(config: DialsConfig) -> Dials:
    return Dials(config.agents, config.steps)


ENTRY = parallel_entry("dials", "agents set two dials each", DialsConfig, parallel_env)
