"""Agents that die stay until the episode ends, with observations and rewards of zero."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from pettingzoo.utils import BaseParallelWrapper

Stepped = tuple[dict[str, Any], dict[str, float], dict[str, bool], dict[str, bool], dict[str, dict[str, Any]]]


class BlackDeath(BaseParallelWrapper):  # type: ignore[misc]  # pettingzoo's types are skipped: see pyproject.toml
    """SuperSuit's black_death_v3, except for the end of an episode.

    SuperSuit 3.11 ends an episode only if all agents are terminated and truncated in the same step, which
    hardly ever happens: the episode goes on for one more step of zeros and then reports both (fixed in its
    repository by pull request 265). Here the episode ends with the last agents' last step: truncated if one
    of them was truncated, else terminated.
    """

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, dict[str, Any]]]:
        observations, infos = self.env.reset(seed=seed, options=options)
        self.agents = list(self.env.possible_agents)
        return self._with_zeros(observations), {agent: infos.get(agent, {}) for agent in self.agents}

    def step(self, actions: Mapping[str, Any]) -> Stepped:
        live = {agent: actions[agent] for agent in self.env.agents}
        observations, rewards, terminated, truncated, infos = self.env.step(live)
        ended = not self.env.agents or all(
            terminated.get(agent) or truncated.get(agent) for agent in self.env.agents
        )
        cut = ended and any(truncated.values())
        stepped = (
            self._with_zeros(observations),
            {agent: rewards.get(agent, 0.0) for agent in self.agents},
            dict.fromkeys(self.agents, ended and not cut),
            dict.fromkeys(self.agents, cut),
            {agent: infos.get(agent, {}) for agent in self.agents},
        )
        if ended:
            self.agents = []
        return stepped

    def _with_zeros(self, observations: Mapping[str, Any]) -> dict[str, Any]:
        return {
            agent: observations.get(agent, np.zeros_like(self.observation_space(agent).low))
            for agent in self.agents
        }
