"""Batched environment of one copy, the maximum per process."""

from typing import Any, Never

import numpy as np
from numpy.typing import NDArray

from headway.contracts import Discrete, EnvSpec, HeadwayError, Observations, StepResult, generator
from headway_envs.junctions import kernel
from headway_envs.junctions.metrics import METRICS, EpisodeMetrics
from headway_envs.junctions.observation import features
from headway_envs.junctions.prepared import Prepared
from headway_envs.junctions.traffic import ACCELERATIONS, Traffic
from headway_envs.step_arrays import step_arrays, step_result
from headway_envs.sumo_simulation import COMMON_OPTIONS, Simulation


class JunctionsBatchedEnv:
    """Junctions without signals; implements `headway.contracts.BatchedEnv`.

    Agents are slots for automated vehicles (AVs). An AV takes the lowest free slot when it enters and frees
    it when it leaves or collides. Actions are the accelerations `ACCELERATIONS`. An AV that collides is
    terminated; one that leaves is truncated with its last observation, because the team's reward goes on; at
    the horizon all AVs are truncated.
    """

    def __init__(self, prepared: Prepared, copies: int) -> None:
        """Allocate arrays; `reset` loads SUMO. Raises HeadwayError unless `copies` is 1."""
        if copies != 1:
            raise HeadwayError(
                f"a process can hold 1 copy of the junctions, not {copies}; set rollout.block=1, with one "
                "worker process per copy"
            )
        config = self.config = prepared.config
        self.prepared = prepared
        network = prepared.network
        described = features(prepared.approaches, network.speed_limit)
        approaches = len(network.approaches)
        self._spec = EnvSpec(
            name="junctions",
            agents=tuple(f"av_{slot}" for slot in range(config.slots)),
            observation_size=len(described),
            action_space=Discrete(len(ACCELERATIONS)),
            state_size=kernel.STATE_PER_APPROACH * approaches + 1,
            shared_reward=True,
            agents_come_and_go=True,
            metrics=METRICS,
            observation_features=described,
            max_copies_per_process=1,
        )
        arrays = self._arrays = step_arrays(self._spec, 1)
        self._observed = Observations(arrays["observations"], arrays["states"], arrays["alive"])
        self._outcome = step_result(arrays)
        self._first = np.zeros(approaches, np.int64)
        self._traffic: Traffic | None = None
        self._seed, self._episode = 0, 0
        self.counters = EpisodeMetrics(config)

    @property
    def spec(self) -> EnvSpec:
        return self._spec

    @property
    def num_copies(self) -> int:
        return 1

    @property
    def traffic(self) -> Traffic:
        """Vehicles and simulation, for rules and pictures; created at the first use."""
        if self._traffic is None:
            prepared, config = self.prepared, self.config
            options = {**COMMON_OPTIONS, "step-length": str(config.step_s)}
            if config.vph is not None:
                options["max-depart-delay"] = str(config.step_s)
            simulation = Simulation(prepared.network.path, prepared.routes, options)
            self._traffic = Traffic(config, prepared.network, simulation)
        return self._traffic

    @property
    def steps_taken(self) -> int:
        """Number of steps taken in the current episode, without the lead-in."""
        return self.counters.steps

    def observed(self) -> Observations:
        """Return the current observations: views of the environment's arrays."""
        return self._observed

    def reset(self, seeds: NDArray[np.uint64]) -> Observations:
        """Begin episode 0; seeds (1,). Raises ValueError for another shape, and HeadwayError if SUMO cannot
        load the network or another environment of this process holds the simulation."""
        if len(seeds) != 1:
            raise ValueError(f"seeds must have shape (1,), not {np.shape(seeds)}")
        self._seed, self._episode = int(seeds[0]), 0
        self._begin()
        return self._observed

    def step(self, actions: NDArray[Any]) -> tuple[StepResult, Observations]:
        """Advance by one step; actions (1, N). Raises ValueError for another shape."""
        outcome, alive = self._outcome, self._observed.alive[0]
        if actions.shape != (1, len(alive)):
            raise ValueError(f"actions must have shape {(1, len(alive))}, not {actions.shape}")
        for flags in (outcome.terminated, outcome.truncated, outcome.episode_ended):
            flags.fill(False)
        outcome.acting[0] = alive
        self.traffic.command(actions[0], alive)
        changes = self.traffic.advance()
        reward = changes.arrived - self.config.collision * changes.collided
        outcome.rewards.fill(reward)
        for slots, ended in ((changes.left, outcome.truncated), (changes.crashed, outcome.terminated)):
            ended[0, list(slots)] = True
            outcome.final_observations[0, list(slots)] = self._observed.observations[0, list(slots)]
        self.counters.count(changes, self.traffic, reward)
        self._observe()
        if self.counters.steps >= self.config.horizon:
            self._end()
        return outcome, self._observed

    def snapshot(self) -> Never:
        """Raise HeadwayError: a simulation state saved by SUMO does not continue exactly."""
        raise HeadwayError("the junctions have no snapshots; their episodes restart on resume")

    def restore(self, snapshot: object) -> Never:
        """Raise HeadwayError: there are no snapshots."""
        raise HeadwayError("the junctions have no snapshots; their episodes restart on resume")

    def close(self) -> None:
        """Release the simulation for other environments of this process."""
        if self._traffic is not None:
            self._traffic.simulation.close()

    def _begin(self) -> None:
        self.counters = EpisodeMetrics(self.config)
        draw = generator(self._seed, "junctions", self._episode)
        self.traffic.begin(int(draw.integers(2**31 - 1)))
        for _ in range(round(self.config.lead_in_s / self.config.step_s)):
            self.traffic.advance()
        self._observe()

    def _observe(self) -> None:
        vehicles = self.traffic.vehicles.values()
        approach = np.array([vehicle.approach for vehicle in vehicles], np.int64)
        distance = np.array([vehicle.distance for vehicle in vehicles], np.float64)
        state = self._observed.states[0]
        kernel.observe(
            np.lexsort((distance, approach)),
            approach,
            distance,
            np.array([vehicle.speed for vehicle in vehicles], np.float64),
            np.array([vehicle.slot for vehicle in vehicles], np.int64),
            self.prepared.network.others,
            self.prepared.network.speed_limit,
            np.zeros(len(approach), np.int64),
            self._first,
            self._observed.observations[0],
            self._observed.alive[0],
            state[:-1],
        )
        state[-1] = self.counters.steps / self.config.horizon

    def _end(self) -> None:
        """End the streams of all slots and begin the next episode."""
        outcome = self._outcome
        rest = ~(outcome.terminated[0] | outcome.truncated[0])
        outcome.truncated[0, rest] = True
        outcome.final_observations[0, rest] = self._observed.observations[0, rest]
        outcome.final_states[:] = self._observed.states
        outcome.metrics[0] = self.counters.metrics()
        outcome.episode_ended[0] = True
        self._episode += 1
        self._begin()
