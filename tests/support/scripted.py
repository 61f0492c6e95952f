"""A ParallelEnv whose steps a function of the test changes."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium import spaces
from pettingzoo import ParallelEnv

Space = spaces.Space[Any]
Script = Callable[["Scripted"], None]


class Scripted(ParallelEnv):  # type: ignore[misc]  # pettingzoo's types are skipped: see pyproject.toml
    """Agents observe (seed, steps taken, own number) for `length` steps; `script` then changes what the step
    returns."""

    metadata: Mapping[str, Any] = {"name": "scripted"}

    def __init__(
        self,
        script: Script = lambda env: None,
        observation_spaces: Mapping[str, Space] | None = None,
        action_spaces: Mapping[str, Space] | None = None,
        agents: Sequence[str] = ("a", "b"),
        length: int = 4,
        **metadata: object,
    ) -> None:
        self.script, self.metadata = script, {"name": "scripted", **metadata}
        self.possible_agents = list(agents)
        self.observation_spaces = observation_spaces or dict.fromkeys(agents, spaces.Box(-9, 2**31, (3,)))
        self.action_spaces = action_spaces or dict.fromkeys(agents, spaces.Discrete(2))
        self.given: list[dict[str, Any]] = []
        self.agents: list[str] = []
        self.render_mode, self.length = None, length
        self.start = 0

    def observation_space(self, agent: str) -> Space:
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> Space:
        return self.action_spaces[agent]

    def reset(self, seed: int | None = None, options: object = None) -> tuple[dict[str, Any], dict[str, Any]]:
        self.agents, self.steps, self.start = list(self.possible_agents), 0, (seed or 0) % 1000
        self._collect(ended=False)
        return self.observations, self.infos

    def step(self, actions: dict[str, Any]) -> tuple[Any, ...]:
        self.given.append(actions)
        self.steps += 1
        self._collect(ended=self.steps == self.length)
        self.agents = [x for x in self.agents if not (self.terminated.get(x) or self.truncated.get(x))]
        return self.observations, self.rewards, self.terminated, self.truncated, self.infos

    def _collect(self, ended: bool) -> None:
        self.observations: dict[str, Any] = {}
        for agent in self.agents:
            row = np.zeros(self.observation_space(agent).shape or (), dtype=np.float32)
            row.flat[:3] = (self.start, self.steps, self.possible_agents.index(agent))
            self.observations[agent] = row
        self.rewards: dict[str, Any] = dict.fromkeys(self.agents, 1.0)
        self.terminated: dict[str, Any] = dict.fromkeys(self.agents, False)
        self.truncated: dict[str, Any] = dict.fromkeys(self.agents, ended)
        self.infos: dict[str, dict[str, Any]] = {agent: {} for agent in self.agents}
        self.script(self)
