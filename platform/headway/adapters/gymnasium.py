"""A single-agent Gymnasium environment as a ParallelEnv with N = 1."""

from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray
from pettingzoo import ParallelEnv

from headway.adapters.spaces import Space

AGENT = "agent"
"""Name of the only agent."""


class SingleAgent(ParallelEnv):  # type: ignore[misc]  # PettingZoo comes without types
    """A Gymnasium environment as a ParallelEnv of one agent. Infos are passed on."""

    def __init__(self, env: gymnasium.Env[Any, Any]) -> None:
        self._env = env
        self.possible_agents = [AGENT]
        self.agents: list[str] = []
        self.metadata, self.render_mode = env.metadata, env.render_mode

    def observation_space(self, agent: str) -> Space:
        return self._env.observation_space

    def action_space(self, agent: str) -> Space:
        return self._env.action_space

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, dict[str, Any]]]:
        observation, info = self._env.reset(seed=seed, options=options)
        self.agents = [AGENT]
        return {AGENT: observation}, {AGENT: info}

    def step(
        self, actions: dict[str, Any]
    ) -> tuple[dict[str, Any], dict[str, float], dict[str, bool], dict[str, bool], dict[str, dict[str, Any]]]:
        observation, reward, terminated, truncated, info = self._env.step(actions[AGENT])
        if terminated or truncated:
            self.agents = []
        return (
            {AGENT: observation},
            {AGENT: float(reward)},
            {AGENT: bool(terminated)},
            {AGENT: bool(truncated)},
            {AGENT: info},
        )

    def state(self) -> NDArray[np.float32]:
        """Raise NotImplementedError: there is no state beyond the agent's observation."""
        raise NotImplementedError

    def render(self) -> Any:  # noqa: ANN401 - a picture, text or nothing
        """Render in `render_mode`."""
        self._env.unwrapped.render_mode = self.render_mode
        return self._env.render()

    def close(self) -> None:
        self._env.close()
