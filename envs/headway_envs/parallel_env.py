"""One copy of a batched environment as a PettingZoo ParallelEnv, for use in other libraries."""

from collections.abc import Callable
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray
from pettingzoo import ParallelEnv

from headway.contracts import (
    BatchedEnv,
    Box,
    Discrete,
    EnvSpec,
    MultiDiscrete,
    Observations,
    StepResult,
    child_seeds,
)

AgentObservations = dict[str, NDArray[np.float32]]
Infos = dict[str, dict[str, Any]]
Stepped = tuple[AgentObservations, dict[str, float], dict[str, bool], dict[str, bool], Infos]


class ParallelEnvBase(ParallelEnv):  # type: ignore[misc]  # pettingzoo's types are skipped: see pyproject.toml
    """PettingZoo ParallelEnv over one copy of a batched environment.

    `reset(seed=s)` begins episode 0 of seed s; `reset()` begins one of a seed derived from the last seed. An
    agent stays in `agents` until it is terminated or truncated. Infos hold `alive` and `acting` in
    environments whose agents come and go (an absent agent observes zeros), `action_mask` in environments with
    action masks, and `episode_metrics` at the end of an episode.
    """

    render_mode: str | None = None

    def __init__(
        self,
        make: Callable[[int], BatchedEnv],
        name: str | None = None,
        bound: float = np.inf,
        low: float | None = None,
    ) -> None:
        """Wrap one copy made by `make`: (copies) -> batched environment.

        `name` (default: that of the spec) is shown outside. Observations are declared to lie between `low`
        (default: -`bound`) and `bound`.
        """
        self._env = make(1)
        spec = self._env.spec
        self.metadata = {
            "name": name or spec.name,
            "render_modes": [] if self.render_mode is None else [self.render_mode],
            "episode_metrics": spec.metrics,
            "agents_come_and_go": spec.agents_come_and_go,
        }
        self.possible_agents = list(spec.agents)
        self.agents: list[str] = []
        self._index = {agent: index for index, agent in enumerate(spec.agents)}
        least = -bound if low is None else low
        self._observation_space = spaces.Box(least, bound, (spec.observation_size,), np.float32)
        self._action_spaces = {agent: _action_space(spec) for agent in self.possible_agents}
        self.state_space = spaces.Box(-np.inf, np.inf, (spec.state_size,), np.float32)
        space = spec.action_space
        self._actions = np.zeros((1, spec.num_agents, *space.shape), space.dtype)
        self._seed = int(np.random.SeedSequence().generate_state(1)[0])
        self._state = np.zeros(spec.state_size, dtype=np.float32)
        self._observed: Observations | None = None

    @property
    def native(self) -> tuple[BatchedEnv, Observations]:
        """The batched environment of one copy and its latest observations, as rules need them. Requires a
        `reset` first."""
        assert self._observed is not None, "reset first"
        return self._env, self._observed

    def observation_space(self, agent: str) -> spaces.Box:
        return self._observation_space

    def action_space(self, agent: str) -> spaces.Space[Any]:
        return self._action_spaces[agent]

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[AgentObservations, Infos]:
        observed = self._begin(seed)
        self.agents = list(self.possible_agents)
        infos: Infos = {agent: {} for agent in self.agents}
        self._add_presence(infos, observed)
        return self._shown(observed.observations, observed.alive), infos

    def step(self, actions: dict[str, Any]) -> Stepped:
        for agent, action in actions.items():
            self._actions[0, self._index[agent]] = action
        outcome, observed = self._advance()
        stepped = self.agents
        ended = bool(outcome.episode_ended[0])
        over = outcome.terminated[0] | outcome.truncated[0]
        infos: Infos = {agent: {} for agent in stepped}
        if ended:
            observations = self._shown(outcome.final_observations, over[None])
            metrics = self._metrics(outcome)
            for info in infos.values():
                info["episode_metrics"] = metrics
        else:
            observations = self._shown(
                np.where(over[None, :, None], outcome.final_observations, observed.observations),
                observed.alive | over[None],
            )
            self._add_presence(infos, observed)
        if self._env.spec.agents_come_and_go:
            for agent, info in infos.items():
                info["acting"] = bool(outcome.acting[0, self._index[agent]])
        self.agents = [] if ended else [agent for agent in stepped if not over[self._index[agent]]]
        return (observations, *self._results(stepped, outcome), infos)

    def state(self) -> NDArray[np.float32]:
        """Return the state (S,). Raises NotImplementedError if the environment has no state."""
        if not self._env.spec.state_size:
            raise NotImplementedError(f"environment '{self._env.spec.name}' has no state")
        return self._state

    def render(self) -> NDArray[np.uint8] | None:
        """Return None: there is no picture unless a subclass draws one."""
        return None

    def close(self) -> None:
        self._env.close()

    def _begin(self, seed: int | None) -> Observations:
        self._seed = int(child_seeds(self._seed, "face", 1, 1)[0]) if seed is None else seed
        self._observed = observed = self._env.reset(np.array([self._seed], np.uint64))
        self._state = observed.states[0].copy()
        return observed

    def _advance(self) -> tuple[StepResult, Observations]:
        outcome, self._observed = self._env.step(self._actions)
        ended = bool(outcome.episode_ended[0])
        self._state = (outcome.final_states if ended else self._observed.states)[0].copy()
        return outcome, self._observed

    def _metrics(self, outcome: StepResult) -> dict[str, float]:
        return dict(zip(self._env.spec.metrics, outcome.metrics[0].tolist(), strict=True))

    def _shown(self, values: NDArray[np.float32], given: NDArray[np.bool_]) -> AgentObservations:
        """Return the rows of `values` (1, N, D) by name of the current agents; zeros where `given` (1, N) is
        false."""
        rows = np.where(given[0, :, None], values[0], np.float32(0))
        return {agent: rows[self._index[agent]] for agent in self.agents}

    def _add_presence(self, infos: Infos, observed: Observations) -> None:
        for agent, info in infos.items():
            index = self._index[agent]
            if self._env.spec.agents_come_and_go:
                info["alive"] = bool(observed.alive[0, index])
            if observed.action_masks is not None:
                info["action_mask"] = observed.action_masks[0, index].astype(np.int8)

    def _results(
        self, stepped: list[str], outcome: StepResult
    ) -> tuple[dict[str, float], dict[str, bool], dict[str, bool]]:
        index = self._index
        return (
            {agent: float(outcome.rewards[0, index[agent]]) for agent in stepped},
            {agent: bool(outcome.terminated[0, index[agent]]) for agent in stepped},
            {agent: bool(outcome.truncated[0, index[agent]]) for agent in stepped},
        )


def _action_space(spec: EnvSpec) -> spaces.Space[Any]:
    match spec.action_space:
        case Discrete(n=n):
            return spaces.Discrete(n)
        case MultiDiscrete(nvec=nvec):
            return spaces.MultiDiscrete(list(nvec))
        case Box(low=low, high=high):
            return spaces.Box(np.array(low, dtype=np.float32), np.array(high, dtype=np.float32))


def from_batched(make: Callable[[Any, int], BatchedEnv], prepared: Any) -> ParallelEnvBase:  # noqa: ANN401
    """Return one copy of `make(prepared, copies)` as a ParallelEnv without declared bounds."""
    return ParallelEnvBase(lambda copies: make(prepared, copies))
