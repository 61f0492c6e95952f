"""Batched environment of one copy, the maximum per process."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from headway.contracts import Discrete, EnvSpec, Observations, StepResult, generator
from headway.contracts.environment import step_arrays, step_result
from headway_envs import platoons
from headway_envs.junctions.metrics import METRICS, EpisodeMetrics
from headway_envs.junctions.prepared import Prepared
from headway_envs.junctions.traffic import ACCELERATIONS, Traffic
from headway_envs.sumo_env import SumoEnv
from headway_envs.sumo_simulation import COMMON_OPTIONS

SIGHT_M = 100.0
"""Distance to the end of an approach at which observed distances are clipped, m."""


class JunctionsBatchedEnv(SumoEnv):
    """Junctions without signals; implements `headway.contracts.BatchedEnv`.

    Agents are slots for automated vehicles (AVs). An AV takes the lowest free slot when it enters and frees
    it when it leaves or collides. Actions are the accelerations `ACCELERATIONS`. An AV that collides is
    terminated; one that leaves is truncated with its last observation, because the team's reward goes on; at
    the horizon all AVs are truncated.
    """

    def __init__(self, prepared: Prepared, copies: int) -> None:
        """Allocate arrays; `reset` loads SUMO. Raises HeadwayError unless `copies` is 1."""
        options = {**COMMON_OPTIONS, "step-length": str(prepared.config.step_s)}
        if prepared.config.vph:
            options["max-depart-delay"] = options["step-length"]
        super().__init__("the junctions", copies, prepared.network.path, options)
        config = self.config = prepared.config
        self.prepared = prepared
        network = prepared.network
        described = platoons.features(prepared.approaches, SIGHT_M, network.speed_limit)
        approaches = len(network.approaches)
        self._spec = EnvSpec(
            name="junctions",
            agents=tuple(f"av_{slot}" for slot in range(config.slots)),
            observation_size=len(described),
            action_space=Discrete(len(ACCELERATIONS)),
            state_size=3 * approaches + 1,
            shared_reward=True,
            agents_come_and_go=True,
            metrics=METRICS,
            observation_features=described,
            max_copies_per_process=1,
        )
        arrays = step_arrays(self._spec, 1)
        self._observed = Observations(arrays["observations"], arrays["states"], arrays["alive"])
        self._outcome = step_result(arrays)
        self._first = np.zeros(approaches, np.int64)
        self._traffic: Traffic | None = None
        self.counters = EpisodeMetrics(config)
        self.demand = 0
        """Number of the present episode's demand in `Prepared.routes`."""

    @property
    def traffic(self) -> Traffic:
        """Vehicles and simulation, for rules and pictures; created at the first use."""
        if self._traffic is None:
            self._traffic = Traffic(self.config, self.prepared.network, self.simulation)
        return self._traffic

    @property
    def steps_taken(self) -> int:
        """Number of steps taken in the current episode, without the lead-in."""
        return self.counters.steps

    def step(self, actions: NDArray[Any]) -> tuple[StepResult, Observations]:
        """Advance by one step; actions (1, N). Raises ValueError for another shape."""
        outcome, alive = self._outcome, self._observed.alive[0]
        if actions.shape != (1, len(alive)):
            raise ValueError(f"actions must have shape {(1, len(alive))}, not {actions.shape}")
        self._begin_step()
        self.traffic.command(actions[0], alive)
        changes = self.traffic.advance()
        reward = changes.arrived - self.config.collision * changes.collided
        outcome.rewards.fill(reward)
        self._end_streams(changes.left, outcome.truncated)
        self._end_streams(changes.crashed, outcome.terminated)
        self.counters.count(changes, self.traffic, reward)
        self._observe()
        if self.counters.steps >= self.config.horizon:
            self._end_episode()
        return outcome, self._observed

    def _begin(self) -> None:
        self.counters = EpisodeMetrics(self.config)
        seed, episode = self.episode
        draw = generator(seed, "junctions", episode)
        sumo_seed, routes = int(draw.integers(2**31 - 1)), self.prepared.routes
        self.demand = int(draw.integers(len(routes)))
        self.traffic.begin(sumo_seed, routes[self.demand])
        for _ in range(round(self.config.lead_in_s / self.config.step_s)):
            self.traffic.advance()
        self._observe()

    def _observe(self) -> None:
        vehicles = self.traffic.vehicles.values()
        approach = np.array([vehicle.approach for vehicle in vehicles], np.int64)
        distance = np.array([vehicle.distance for vehicle in vehicles], np.float64)
        speed = np.array([vehicle.speed for vehicle in vehicles], np.float64)
        slot = np.array([vehicle.slot for vehicle in vehicles], np.int64)
        state, limit = self._observed.states[0], self.prepared.network.speed_limit
        platoons.observe(
            np.lexsort((distance, approach)),
            approach,
            distance,
            speed,
            slot,
            self.prepared.network.others,
            SIGHT_M,
            limit,
            self._spec.observation_size // 2,
            np.zeros(len(approach), np.int64),
            self._first,
            self._observed.observations[0],
            self._observed.alive[0],
        )
        before = (approach >= 0) & (distance >= 0.0)
        counted = (None, (slot >= 0)[before], speed[before])
        total, avs, speeds = (np.bincount(approach[before], of, len(self._first)) for of in counted)
        state[:-1].reshape(-1, 3)[:] = np.column_stack(
            (0.1 * avs, 0.1 * (total - avs), speeds / np.maximum(total, 1) / limit)
        )
        state[-1] = self.counters.steps / self.config.horizon

    def _metrics(self) -> Sequence[float]:
        return self.counters.metrics()
