"""The PettingZoo face of the bus environment: a batch of one copy."""

from typing import Any, ClassVar

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray
from pettingzoo import ParallelEnv

from headway.contracts import Observed
from headway_envs.bus.config import BusConfig
from headway_envs.bus.env import BusBatchedEnv
from headway_envs.bus.kernel.layout import METRICS
from headway_envs.bus.prepared import Prepared, prepare

Observation = NDArray[np.float32]
Info = dict[str, Any]


class BusParallelEnv(ParallelEnv):  # type: ignore[misc]  # PettingZoo comes without types
    """One service day as a ParallelEnv. Every slot stays in `agents` all day; `info` of each agent carries
    `alive`, `acting`, `action_mask`, and at the end `episode_metrics`, by name. The same seed gives the
    same days as `BusBatchedEnv.reset([seed])`."""

    metadata: ClassVar[dict[str, Any]] = {
        "name": "headway_bus_v0",
        "render_modes": [],
        "episode_metrics": tuple(METRICS),
    }
    render_mode = None

    def __init__(self, config: BusConfig | Prepared | None = None) -> None:
        prepared = config if isinstance(config, Prepared) else prepare(config or BusConfig())
        self._env = BusBatchedEnv(prepared, 1)
        spec = self._env.spec
        self.possible_agents = list(spec.agents)
        self.agents: list[str] = []
        self._seeds = np.random.SeedSequence()
        low = 0.0 if prepared.config.observation != "control" else -5.0
        high = 1.0 if prepared.config.observation != "control" else 5.0
        box = spaces.Box(low, high, (spec.observation_size,), np.float32)
        self.observation_spaces = dict.fromkeys(spec.agents, box)
        self.action_spaces = {name: spaces.Discrete(3) for name in spec.agents}
        self.state_space = spaces.Box(-np.inf, np.inf, (spec.state_size,), np.float32)
        self._state = np.zeros(spec.state_size, np.float32)

    @property
    def native(self) -> tuple[BusBatchedEnv, Observed]:
        """The batch of one copy behind it, and what that observed last: where the rules look."""
        return self._env, self._env.observed()

    def observation_space(self, agent: str) -> spaces.Box:
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> spaces.Discrete:
        return self.action_spaces[agent]

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Observation], dict[str, Info]]:
        """Begin day 0 of `seed`; without one, of a seed that has not been used."""
        if seed is None:
            drawn = self._seeds.spawn(1)[0].generate_state(1, np.uint64).astype(np.uint64)
        else:
            drawn = np.array([seed], np.uint64)
        observed = self._env.reset(drawn)
        self.agents = list(self.possible_agents)
        self._state = observed.states[0].copy()
        return self._by_agent(observed.observations[0]), self._infos(observed.alive[0])

    def step(
        self, actions: dict[str, int]
    ) -> tuple[
        dict[str, Observation],
        dict[str, float],
        dict[str, bool],
        dict[str, bool],
        dict[str, Info],
    ]:
        """One control interval."""
        latched = np.array([[actions[name] for name in self.possible_agents]], np.int64)
        outcome, observed = self._env.step(latched)
        ended = bool(outcome.episode_ended[0])
        alive = np.zeros_like(observed.alive[0]) if ended else observed.alive[0]
        seen = outcome.final_observations[0] if ended else observed.observations[0]
        self._state = (outcome.final_states if ended else observed.states)[0].copy()
        infos = self._infos(alive)
        for n, name in enumerate(self.possible_agents):
            infos[name]["acting"] = bool(outcome.acting[0, n])
            if ended:
                metrics = outcome.metrics[0].tolist()
                infos[name]["episode_metrics"] = dict(zip(self._env.spec.metrics, metrics, strict=True))
        rewards = {name: float(outcome.rewards[0, n]) for n, name in enumerate(self.possible_agents)}
        terminations = dict.fromkeys(self.possible_agents, ended)
        truncations = dict.fromkeys(self.possible_agents, False)
        if ended:
            self.agents = []
        return self._by_agent(seen), rewards, terminations, truncations, infos

    def state(self) -> NDArray[np.float32]:
        """The global state (S,)."""
        return self._state

    def render(self) -> None:
        """There is no render mode."""

    def close(self) -> None:
        self._env.close()

    def _by_agent(self, observations: NDArray[np.float32]) -> dict[str, Observation]:
        return {name: observations[n].copy() for n, name in enumerate(self.possible_agents)}

    def _infos(self, alive: NDArray[np.bool_]) -> dict[str, Info]:
        masks = self._env.outputs.masks[0].astype(np.int8)
        return {
            name: {"alive": bool(alive[n]), "acting": False, "action_mask": masks[n].copy()}
            for n, name in enumerate(self.possible_agents)
        }
