"""PettingZoo ParallelEnv of an environment whose agents are slots for vehicles that come and go."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from headway_envs.parallel_env import AgentObservations, Infos, ParallelEnvBase, Stepped


class SlotsParallelEnv(ParallelEnvBase):
    """Slots as agents that stay until the episode ends, for libraries with a fixed number of agents and for
    Headway's wrappers.

    Each info holds `alive` and `acting`, `slot_ended` (`terminated` or `truncated`) in the step in which the
    slot's vehicle left, together with its last observation, and `episode_metrics` at the end of the episode.
    An empty slot observes zeros, and its action is ignored."""

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[AgentObservations, Infos]:
        """Begin episode 0 of `seed`; None: of a seed derived from the last one."""
        observed = self._begin(seed)
        self.agents = list(self.possible_agents)
        alive = observed.alive[0].tolist()
        return self._by_agent(observed.observations[0]), {
            name: {"alive": there, "acting": False} for name, there in zip(self.agents, alive, strict=True)
        }

    def step(self, actions: dict[str, Any]) -> Stepped:
        """Apply an action per slot."""
        names = self.possible_agents
        self._actions[0] = [actions[name] for name in names]
        outcome, observed = self._advance()
        ended = bool(outcome.episode_ended[0])
        over = outcome.terminated[0] | outcome.truncated[0]
        seen = np.where(over[:, None], outcome.final_observations[0], observed.observations[0])
        alive = observed.alive[0] & (not ended)
        infos: Infos = {
            name: {"alive": there, "acting": acted}
            for name, there, acted in zip(names, alive.tolist(), outcome.acting[0].tolist(), strict=True)
        }
        terminated = dict(zip(names, (outcome.terminated[0] & ended).tolist(), strict=True))
        truncated = dict(zip(names, (outcome.truncated[0] & ended).tolist(), strict=True))
        if ended:
            self.agents = []
            metrics = self._metrics(outcome)
            for info in infos.values():
                info["episode_metrics"] = metrics
        else:
            for slot in np.flatnonzero(over).tolist():
                infos[names[slot]]["slot_ended"] = (
                    "terminated" if outcome.terminated[0, slot] else "truncated"
                )
        rewards = dict(zip(names, outcome.rewards[0].tolist(), strict=True))
        return self._by_agent(seen), rewards, terminated, truncated, infos

    def _by_agent(self, observations: NDArray[np.float32]) -> AgentObservations:
        return dict(zip(self.possible_agents, observations.copy(), strict=True))
