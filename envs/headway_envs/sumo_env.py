"""Base class of batched environments in SUMO, whose agents are slots for vehicles that come and go."""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Never

import numpy as np
from numpy.typing import NDArray

from headway.contracts import EnvSpec, HeadwayError, Observations, StepResult
from headway_envs.sumo_simulation import Simulation


class SumoEnv(ABC):
    """Implementation of `headway.contracts.BatchedEnv`, except `step`, for one copy with N slots.

    A subclass sets `_spec`, `_observed` and `_outcome`, and in its `step` calls `_begin_step`, `_end_streams`
    and `_end_episode`.
    """

    _spec: EnvSpec
    _observed: Observations
    """Current observations: views of the environment's arrays."""
    _outcome: StepResult
    """Result of the last step."""

    def __init__(self, name: str, copies: int, network: str, options: Mapping[str, str]) -> None:
        """`name`: the environment in messages; `network`: path of the network file; `options`: SUMO's options
        by name, except the seed. Raises HeadwayError unless `copies` is 1."""
        if copies != 1:
            raise HeadwayError(
                f"a process can hold 1 copy of {name}, not {copies}; set rollout.block=1, with one worker "
                "process per copy"
            )
        self._seed, self._episode = 0, 0
        self._network, self._options = network, options
        self._simulation: Simulation | None = None

    @property
    def spec(self) -> EnvSpec:
        return self._spec

    @property
    def num_copies(self) -> int:
        return 1

    @property
    def simulation(self) -> Simulation:
        """The simulation; created at the first use."""
        if self._simulation is None:
            self._simulation = Simulation(self._network, self._options)
        return self._simulation

    @property
    def episode(self) -> tuple[int, int]:
        """Seed of the last `reset`, and number of episodes that have ended since."""
        return self._seed, self._episode

    @abstractmethod
    def _begin(self) -> None:
        """Begin the episode `episode`."""

    @abstractmethod
    def _metrics(self) -> Sequence[float]:
        """Return the metrics of the episode that has ended, in the order of `EnvSpec.metrics`."""

    def observed(self) -> Observations:
        """Return the current observations: views of the environment's arrays."""
        return self._observed

    def reset(self, seeds: NDArray[np.uint64]) -> Observations:
        """Begin episode 0; seeds (1,).

        Raises ValueError for another shape, and HeadwayError if SUMO cannot load the network or another
        environment of this process holds the simulation.
        """
        if len(seeds) != 1:
            raise ValueError(f"seeds must have shape (1,), not {np.shape(seeds)}")
        self._seed, self._episode = int(seeds[0]), 0
        self._begin()
        return self._observed

    def snapshot(self) -> Never:
        """Raise HeadwayError: a simulation state saved by SUMO does not continue exactly."""
        raise HeadwayError(f"{self._spec.name} has no snapshots; its episodes restart on resume")

    def restore(self, snapshot: object) -> Never:
        """Raise HeadwayError: there are no snapshots."""
        self.snapshot()

    def close(self) -> None:
        """Release the simulation for other environments of this process."""
        if self._simulation is not None:
            self._simulation.close()

    def _begin_step(self) -> None:
        """Clear the result of the last step, and let all slots act that are alive."""
        outcome = self._outcome
        for flags in (outcome.terminated, outcome.truncated, outcome.episode_ended):
            flags.fill(False)
        outcome.acting[:] = self._observed.alive

    def _end_streams(self, slots: Sequence[int], flags: NDArray[np.bool_]) -> None:
        """End streams with their last observation by setting `flags` (1, N). A vehicle that has never acted
        has no stream to end."""
        for slot in slots:
            if self._outcome.acting[0, slot]:
                flags[0, slot] = True
                self._outcome.final_observations[0, slot] = self._observed.observations[0, slot]

    def _end_episode(self, terminated: bool = False) -> None:
        """Truncate or terminate the streams of all slots, and begin the next episode."""
        outcome = self._outcome
        rest = ~(outcome.terminated[0] | outcome.truncated[0])
        (outcome.terminated if terminated else outcome.truncated)[0, rest] = True
        outcome.final_observations[0, rest] = self._observed.observations[0, rest]
        outcome.final_states[:] = self._observed.states
        outcome.metrics[0] = self._metrics()
        outcome.episode_ended[0] = True
        self._episode += 1
        self._begin()
