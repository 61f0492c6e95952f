"""The trivial environment in the usual PettingZoo style, with dictionaries per step."""

from typing import Any, ClassVar

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray
from pettingzoo import ParallelEnv

from headway_envs.toy.trivial import (
    NUM_ACTIONS,
    OBSERVATION_SIZE,
    TrivialConfig,
    agent_names,
    episode_generator,
)


class TrivialParallel(ParallelEnv):  # type: ignore[misc]  # pettingzoo's types are skipped: see pyproject.toml
    """Same episodes as `Trivial`: `reset(seed=s)` begins episode 0 of seed s, `reset()` the next one."""

    metadata: ClassVar[dict[str, Any]] = {
        "name": "trivial",
        "render_modes": [],
        "episode_metrics": ("accuracy",),
    }
    render_mode = None

    def __init__(self, config: TrivialConfig) -> None:
        self._config = config
        self.possible_agents = list(agent_names(config.agents))
        self.agents: list[str] = []
        self._observation_space = spaces.Box(-1.0, 1.0, (OBSERVATION_SIZE,), np.float32)
        self._action_spaces = {agent: spaces.Discrete(NUM_ACTIONS) for agent in self.possible_agents}
        self._seed = int(np.random.SeedSequence().generate_state(1)[0])
        self._episode = -1

    def observation_space(self, agent: str) -> spaces.Box:
        return self._observation_space

    def action_space(self, agent: str) -> spaces.Discrete:
        return self._action_spaces[agent]

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, NDArray[np.float32]], dict[str, dict[str, Any]]]:
        if seed is None:
            self._episode += 1
        else:
            self._seed, self._episode = seed, 0
        self._generator = episode_generator(self._seed, self._episode)
        self.agents = list(self.possible_agents)
        self._step = 0
        self._total = 0
        return self._observe(), {agent: {} for agent in self.agents}

    def step(
        self, actions: dict[str, Any]
    ) -> tuple[
        dict[str, NDArray[np.float32]],
        dict[str, float],
        dict[str, bool],
        dict[str, bool],
        dict[str, dict[str, Any]],
    ]:
        matches = sum(
            int(actions[agent] == np.argmax(self._shown[agent][:NUM_ACTIONS])) for agent in self.agents
        )
        self._total += matches
        self._step += 1
        ended = self._step == self._config.steps
        reward = matches / len(self.agents)
        observations = self._observe()
        rewards = dict.fromkeys(self.agents, reward)
        terminated = dict.fromkeys(self.agents, False)
        truncated = dict.fromkeys(self.agents, ended)
        infos: dict[str, dict[str, Any]] = {agent: {} for agent in self.agents}
        if ended:
            metrics = {"accuracy": self._total / (self._step * len(self.agents))}
            infos = {agent: {"episode_metrics": metrics} for agent in self.agents}
            self.agents = []
        return observations, rewards, terminated, truncated, infos

    def state(self) -> NDArray[np.float32]:
        return np.concatenate(list(self._shown.values()))

    def render(self) -> None:
        """Return None: there is no picture."""

    def _observe(self) -> dict[str, NDArray[np.float32]]:
        self._shown = {
            agent: self._generator.random(OBSERVATION_SIZE, dtype=np.float32) * 2 - 1 for agent in self.agents
        }
        return self._shown
