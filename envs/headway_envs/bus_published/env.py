"""Batched published bus environment."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from headway.contracts import Discrete, EnvSpec, HeadwayError, Observations, StepResult
from headway_envs.array_env import ArrayEnv
from headway_envs.bus_published.kernel import steps
from headway_envs.bus_published.kernel.layout import (
    ACTIONS,
    BUS,
    CALL,
    DAY,
    METRICS,
    OBSERVATION_SIZE,
    Outputs,
    World,
)
from headway_envs.bus_published.prepared import Prepared


class BusPublishedBatchedEnv(ArrayEnv[World, Outputs]):
    """C days stepped together; implements `headway.contracts.BatchedEnv`.

    Every bus acts in every step, and only its own clock advances: 0 WAIT (60 s), 1 MOVE (mean time of the
    link), 2 SERVICE_CENTER (0.3 of the shortest path's time; refused without fuel for it). The day terminates
    for all buses when the first clock reaches its end, and is truncated after `max_steps`.
    """

    _KIND = "scenario, number of buses"

    def __init__(self, prepared: Prepared, copies: int) -> None:
        """Allocate `copies` copies. Raises HeadwayError for fewer than one copy."""
        if copies < 1:
            raise HeadwayError(f"copies must be at least 1, not {copies}")
        self.prepared, self.network, self.settings = prepared, prepared.network, prepared.settings
        buses = len(prepared.agents)
        self.world = World(
            days=np.zeros(copies, DAY),
            buses=np.zeros((copies, buses), BUS),
            calls=np.zeros((copies, len(self.network.call_stop)), CALL),
        )
        self.outputs = Outputs(
            observations=np.zeros((copies, buses, OBSERVATION_SIZE), np.float32),
            rewards=np.zeros((copies, buses), np.float32),
            terminated=np.zeros((copies, buses), np.bool_),
            truncated=np.zeros((copies, buses), np.bool_),
            ended=np.zeros(copies, np.bool_),
            final_observations=np.zeros((copies, buses, OBSERVATION_SIZE), np.float32),
            metrics=np.zeros((copies, len(METRICS))),
        )
        self._always = np.ones((copies, buses), np.bool_)
        self._no_state = np.zeros((copies, 0), np.float32)
        self._spec = EnvSpec(
            name="bus_published",
            agents=prepared.agents,
            observation_size=OBSERVATION_SIZE,
            action_space=Discrete(ACTIONS),
            groups=prepared.groups,
            shared_reward=prepared.config.reward.scope == "team",
            metrics=tuple(METRICS),
            snapshots=True,
        )

    def step(self, actions: NDArray[Any]) -> tuple[StepResult, Observations]:
        """Apply one action per bus; actions (C, N) int64 of 0 to 2.

        Raises ValueError for any other shape of actions.
        """
        actions = self._checked(actions)
        outputs = self.outputs
        steps.step(self.network, self.settings, self.world, outputs, actions)
        outcome = StepResult(
            rewards=outputs.rewards,
            terminated=outputs.terminated,
            truncated=outputs.truncated,
            acting=self._always,
            episode_ended=outputs.ended,
            final_observations=outputs.final_observations,
            final_states=self._no_state,
            metrics=outputs.metrics,
        )
        return outcome, self.observed()

    def observed(self) -> Observations:
        """Return the current observations: views of the environment's arrays."""
        return Observations(self.outputs.observations, self._no_state, self._always)

    def _begin(self, seeds: NDArray[np.uint64]) -> None:
        steps.begin(self.network, self.settings, self.world, self.outputs, seeds)
