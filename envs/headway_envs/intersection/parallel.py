"""PettingZoo ParallelEnvs of the intersection, with vehicles or with slots as agents."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from headway.contracts import HeadwayError, Observations
from headway_envs.intersection.config import IntersectionConfig
from headway_envs.intersection.env import IntersectionBatchedEnv
from headway_envs.intersection.prepared import Prepared, prepare
from headway_envs.parallel_env import AgentObservations, Infos, ParallelEnvBase, Stepped

BOUND = 5.0
"""Declared bound on the components of an observation."""


class _IntersectionParallelBase(ParallelEnvBase):
    """Common base of both ParallelEnvs."""

    render_mode = "rgb_array"
    _env: IntersectionBatchedEnv

    def __init__(self, config: IntersectionConfig | Prepared | None, agents: int | None) -> None:
        """`agents`: number of agent ids; None: one per slot."""
        prepared = config if isinstance(config, Prepared) else prepare(config or IntersectionConfig())
        super().__init__(
            lambda copies: IntersectionBatchedEnv(prepared, copies),
            name="headway_intersection_v0",
            bound=BOUND,
            agents=None if agents is None else [f"av_{index}" for index in range(agents)],
        )

    def render(self) -> NDArray[np.uint8]:
        """Return an RGB picture of the current state, (height, width, 3)."""
        from headway_envs.intersection.renderer import frame_of, render

        return render(frame_of(self._env))


class IntersectionParallelEnv(_IntersectionParallelBase):
    """Vehicles as agents `av_0`, `av_1` ... in order of entry; ids are not reused within an episode.

    Periods without agents are skipped without reward (except the team's reward until the end of a repeated
    action): `reset` returns at least one agent, and so does every `step` but the last. An agent that leaves
    is terminated or truncated, as `at_exit` sets, with `info["event"]` `arrived`, `collided` or `horizon`. A
    vehicle that enters and leaves within one repeated action never becomes an agent. The same seed and
    actions give the same episode as `IntersectionBatchedEnv.reset([seed])`.
    """

    def __init__(self, config: IntersectionConfig | Prepared | None = None, vehicles: int = 128) -> None:
        """`vehicles`: number of agent ids. `step` raises HeadwayError if more AVs enter in one episode."""
        super().__init__(config, vehicles)

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[AgentObservations, Infos]:
        """Begin episode 0 of `seed` (None: derived from the last seed) and advance until the first AV enters.
        Raises HeadwayError if none enters in the whole episode."""
        observed, ended = self._begin(seed), False
        while not (ended or observed.alive.any()):
            outcome, observed = self._advance()
            ended = bool(outcome.episode_ended[0])
        if ended:
            raise HeadwayError(
                "no automated vehicle entered in a whole episode; set horizon or vph_per_lane_av higher"
            )
        there = self._present_agents(observed)
        self.agents = list(there)
        return self._by_name(observed.observations, there), {name: {} for name in there}

    def step(self, actions: dict[str, Any]) -> Stepped:
        """Apply an action per agent, accelerations within 3 m/s^2, and skip periods without agents."""
        before = self._present_agents(self._env.observed())
        for name, slot in before.items():
            self._actions[0, slot] = actions[name]
        outcome, observed = self._advance()
        ended = bool(outcome.episode_ended[0])
        over = outcome.terminated[0] | outcome.truncated[0]
        leaving = {name: slot for name, slot in before.items() if over[slot]}
        observations = self._by_name(outcome.final_observations, leaving)
        rewards = {name: float(outcome.rewards[0, slot]) for name, slot in before.items()}
        terminated = {name: bool(outcome.terminated[0, slot]) for name, slot in before.items()}
        truncated = {name: bool(outcome.truncated[0, slot]) for name, slot in before.items()}
        infos: Infos = {name: {} for name in before}
        for name, slot in leaving.items():
            infos[name]["event"] = self._env.events.get(slot, "horizon")
        while not (ended or observed.alive.any()):
            outcome, observed = self._advance()
            ended = bool(outcome.episode_ended[0])
        if ended:
            self.agents = []
            for info in infos.values():
                info["episode_metrics"] = self._metrics(outcome)
            return observations, rewards, terminated, truncated, infos
        there = self._present_agents(observed)
        self.agents = list(there)
        observations |= self._by_name(observed.observations, there)
        for name in there.keys() - before.keys():
            rewards[name], terminated[name], truncated[name], infos[name] = 0.0, False, False, {}
        return observations, rewards, terminated, truncated, infos

    def _present_agents(self, observed: Observations) -> dict[str, int]:
        """Return the slot of each present agent, by name in order of entry."""
        serial = self._env.bridge.roster.serial
        slots = sorted(np.flatnonzero(observed.alive[0]).tolist(), key=lambda slot: int(serial[slot]))
        if slots and serial[slots[-1]] >= len(self.possible_agents):
            raise HeadwayError(
                f"more than {len(self.possible_agents)} automated vehicles entered in one episode; set "
                "`vehicles` of IntersectionParallelEnv higher"
            )
        return {f"av_{serial[slot]}": slot for slot in slots}

    def _by_name(self, observations: NDArray[np.float32], slots: dict[str, int]) -> AgentObservations:
        return {name: observations[0, slot].copy() for name, slot in slots.items()}


class IntersectionSlotsParallelEnv(_IntersectionParallelBase):
    """Slots as agents that stay until the episode ends, for libraries with a fixed number of agents and for
    Headway's wrappers.

    Each info holds `alive` and `acting`, `slot_ended` (`terminated` or `truncated`) in the step in which the
    slot's vehicle left, together with its last observation, and `episode_metrics` at the end of the episode.
    An empty slot observes zeros, and its action is ignored."""

    def __init__(self, config: IntersectionConfig | Prepared | None = None) -> None:
        super().__init__(config, None)

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
        """Apply an action per slot, accelerations within 3 m/s^2."""
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
