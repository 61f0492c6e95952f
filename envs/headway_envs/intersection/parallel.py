"""The PettingZoo faces of the intersection: vehicles that each live once, or slots that stay."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from headway.contracts import HeadwayError, Observations
from headway_envs.intersection.config import IntersectionConfig
from headway_envs.intersection.env import IntersectionBatchedEnv
from headway_envs.intersection.prepared import Prepared, prepare
from headway_envs.parallel_env import AgentObservations, Infos, ParallelEnvBase, Stepped

BOUND = 5.0
"""Of every component of an observation."""


class _Face(ParallelEnvBase):
    """What both faces share."""

    render_mode = "rgb_array"
    _env: IntersectionBatchedEnv

    def __init__(self, config: IntersectionConfig | Prepared | None, agents: int | None) -> None:
        """`agents`: how many ids there are; None: as many as slots."""
        prepared = config if isinstance(config, Prepared) else prepare(config or IntersectionConfig())
        super().__init__(
            lambda copies: IntersectionBatchedEnv(prepared, copies),
            name="headway_intersection_v0",
            bound=BOUND,
            agents=None if agents is None else [f"av_{index}" for index in range(agents)],
        )

    def render(self) -> NDArray[np.uint8]:
        """A picture of the crossing as it is now, (height, width, 3)."""
        from headway_envs.intersection.renderer import frame_of, render

        return render(frame_of(self._env))


class IntersectionParallelEnv(_Face):
    """Vehicles as agents `av_0`, `av_1` ... in the order in which they enter; each lives once.

    Time in which nobody is there passes by itself, and nobody is paid for it (but by the team's reward until
    the end of an action that lasts for several steps): `reset` ends with at least one agent, and so does
    every `step` but the last. Whoever leaves is terminated or truncated, as `at_exit` says, with
    `info["event"]` `arrived`, `collided` or `horizon`; who enters and leaves while one action lasts has no
    turn. The same seed and actions give the same episode as `IntersectionBatchedEnv.reset([seed])`.
    """

    def __init__(self, config: IntersectionConfig | Prepared | None = None, vehicles: int = 128) -> None:
        """`vehicles`: ids there are. `step` raises HeadwayError where more enter in one episode."""
        super().__init__(config, vehicles)

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[AgentObservations, Infos]:
        """Begin episode 0 of `seed`, or of one derived from the last; it ends when the first AV is there."""
        observed, ended = self._begin(seed), False
        while not (ended or observed.alive.any()):
            outcome, observed = self._advance()
            ended = bool(outcome.episode_ended[0])
        if ended:
            raise HeadwayError(
                "no automated vehicle entered in a whole episode; let horizon or vph_per_lane_av be larger"
            )
        there = self._there(observed)
        self.agents = list(there)
        return self._of_slots(observed.observations, there), {name: {} for name in there}

    def step(self, actions: dict[str, Any]) -> Stepped:
        """An action, and as long as nobody is there; accelerations within 3 m/s^2."""
        before = self._there(self._env.observed())
        for name, slot in before.items():
            self._actions[0, slot] = actions[name]
        outcome, observed = self._advance()
        ended = bool(outcome.episode_ended[0])
        over = outcome.terminated[0] | outcome.truncated[0]
        leaving = {name: slot for name, slot in before.items() if over[slot]}
        observations = self._of_slots(outcome.final_observations, leaving)
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
        there = self._there(observed)
        self.agents = list(there)
        observations |= self._of_slots(observed.observations, there)
        for name in there.keys() - before.keys():
            rewards[name], terminated[name], truncated[name], infos[name] = 0.0, False, False, {}
        return observations, rewards, terminated, truncated, infos

    def _there(self, observed: Observations) -> dict[str, int]:
        """Slot of each agent that is there, in the order in which they entered."""
        serial = self._env.street.roster.serial
        slots = sorted(np.flatnonzero(observed.alive[0]).tolist(), key=lambda slot: int(serial[slot]))
        if slots and serial[slots[-1]] >= len(self.possible_agents):
            raise HeadwayError(
                f"more than {len(self.possible_agents)} automated vehicles entered in one episode; give the "
                "IntersectionParallelEnv a larger number of `vehicles`"
            )
        return {f"av_{serial[slot]}": slot for slot in slots}

    def _of_slots(self, observations: NDArray[np.float32], slots: dict[str, int]) -> AgentObservations:
        return {name: observations[0, slot].copy() for name, slot in slots.items()}


class IntersectionSlotsParallelEnv(_Face):
    """Slots as agents that stay until the episode ends, for libraries that want a fixed number, and for
    Headway's wrappers. `info` of each carries `alive` and `acting`; `slot_ended` (`terminated` or
    `truncated`) in the step in which its vehicle left, with what that observed last; and at the episode's end
    `episode_metrics`. An empty slot observes zeros, and its action is ignored."""

    def __init__(self, config: IntersectionConfig | Prepared | None = None) -> None:
        super().__init__(config, None)

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[AgentObservations, Infos]:
        """Begin episode 0 of `seed`, or of one derived from the last."""
        observed = self._begin(seed)
        self.agents = list(self.possible_agents)
        alive = observed.alive[0].tolist()
        return self._by_agent(observed.observations[0]), {
            name: {"alive": there, "acting": False} for name, there in zip(self.agents, alive, strict=True)
        }

    def step(self, actions: dict[str, Any]) -> Stepped:
        """An action; accelerations within 3 m/s^2."""
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
