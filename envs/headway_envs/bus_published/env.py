"""Batched published bus environment."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from headway.contracts import Discrete, EnvSpec, Observations, StepResult
from headway_envs.array_env import ArrayEnv
from headway_envs.bus_published.kernel import steps
from headway_envs.bus_published.kernel.layout import (
    ACTIONS,
    BUS,
    DAY,
    OBSERVATION_SIZE,
    STOP,
    Outputs,
    World,
)
from headway_envs.bus_published.metrics import METRICS
from headway_envs.bus_published.observation import features
from headway_envs.bus_published.prepared import Prepared


class BusPublishedBatchedEnv(ArrayEnv[World, Outputs]):
    """C days stepped together; implements `headway.contracts.BatchedEnv`.

    Every bus acts in every step, and only its own clock advances: 0 WAIT (60 s), 1 MOVE (time of the
    link), 2 SERVICE_CENTER (0.3 of the shortest path's time; refused without fuel for it). The day terminates
    for all buses when the first clock reaches its end, and is truncated after `max_steps`.
    """

    _KIND = "scenario, number of buses"

    def __init__(self, prepared: Prepared, copies: int) -> None:
        """Allocate `copies` copies. Raises HeadwayError for fewer than one copy."""
        self.prepared, self.network, self.settings = prepared, prepared.network, prepared.settings
        self._spec = EnvSpec(
            name="bus_published",
            agents=prepared.agents,
            observation_size=OBSERVATION_SIZE,
            action_space=Discrete(ACTIONS),
            shared_reward=prepared.config.reward.scope == "team",
            metrics=METRICS,
            observation_features=features(prepared),
            snapshots=True,
        )
        self.outputs = Outputs(**self._arrays(copies, Outputs._fields))
        self.world = World(
            days=np.zeros(copies, DAY),
            buses=np.zeros((copies, len(prepared.agents)), BUS),
            stops=np.zeros((copies, len(self.network.demand)), STOP),
        )
        self._always = np.ones(self.outputs.rewards.shape, np.bool_)
        self._no_state = np.zeros((copies, 0), np.float32)
        self._outcome = self._result(acting=self._always, final_states=self._no_state)

    def step(self, actions: NDArray[Any]) -> tuple[StepResult, Observations]:
        """Apply one action per bus; actions (C, N) int64 of 0 to 2.

        Raises ValueError for any other shape of actions.
        """
        steps.step(self.network, self.settings, self.world, self.outputs, self._checked(actions))
        return self._outcome, self.observed()

    def observed(self) -> Observations:
        """Return the current observations: views of the environment's arrays."""
        return Observations(self.outputs.observations, self._no_state, self._always)

    def _redraw(self, seeds: NDArray[np.uint64]) -> None:
        """Do nothing: nothing is random after the start of a day."""

    def _begin(self, seeds: NDArray[np.uint64]) -> None:
        steps.begin(self.network, self.settings, self.world, self.outputs, seeds)
