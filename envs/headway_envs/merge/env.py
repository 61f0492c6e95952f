"""Batched merging environments."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from headway.contracts import Discrete, EnvSpec, Observations, StepResult
from headway_envs.array_env import ArrayEnv
from headway_envs.merge.kernel import steps
from headway_envs.merge.kernel.layout import (
    ACTIONS,
    CAR,
    CAR_STATE,
    EPISODE,
    OBSERVATION_SIZE,
    PREDICTED_STEPS,
    Outputs,
    Workspace,
    World,
)
from headway_envs.merge.metrics import METRICS
from headway_envs.merge.observation import features
from headway_envs.merge.prepared import Prepared


class MergeBatchedEnv(ArrayEnv[World, Outputs]):
    """C merges stepped together; implements `headway.contracts.BatchedEnv`.

    Agents are slots of CAVs; an episode fills the first of them for its whole length (`alive`). Actions last
    0.2 s: 0 change to the left, 1 idle, 2 change to the right, 3 faster, 4 slower. The episode ends for all
    agents when a CAV crashes (terminated) or the time is over (truncated; terminated with the preset
    `paper`). Vehicles drive on beyond the end of the road.
    """

    _KIND = "merge"

    def __init__(self, prepared: Prepared, copies: int) -> None:
        """Allocate `copies` copies. Raises HeadwayError for fewer than one copy."""
        config, self.prepared, self.network = prepared.config, prepared, prepared.network
        slots, cars = len(prepared.agents), prepared.vehicles
        self.settings = prepared.settings
        self._spec = EnvSpec(
            name=prepared.name,
            agents=prepared.agents,
            observation_size=OBSERVATION_SIZE,
            action_space=Discrete(ACTIONS),
            state_size=CAR_STATE * cars + 1,
            shared_reward=config.reward.scope == "global",
            has_action_mask=config.dynamics.masks,
            agents_come_and_go=True,
            metrics=METRICS,
            observation_features=features(prepared),
            snapshots=True,
        )
        arrays = self._arrays(copies, Outputs._fields)
        self.world = World(
            episodes=np.zeros(copies, EPISODE),
            cars=np.zeros((copies, cars + len(self.network.obstacles)), CAR),
        )
        self.outputs = Outputs(
            **arrays, final_episodes=np.zeros(copies, EPISODE), final_cars=np.zeros_like(self.world.cars)
        )
        self._outcome = self._result()
        self._work = Workspace(
            ghosts=np.zeros(2, CAR),
            predicted=np.zeros((4, PREDICTED_STEPS, 4)),
            priorities=np.zeros(slots),
            allowed=np.zeros(ACTIONS, np.bool_),
            own=np.zeros(slots, np.float32),
        )

    def step(self, actions: NDArray[Any]) -> tuple[StepResult, Observations]:
        """Advance by 0.2 s; actions (C, N) int64 of 0 to 4, or 5 to drive as a human (rule `idm_mobil`).

        A change to a lane that does not exist or is closed is ignored. Raises ValueError for any other shape
        of actions.
        """
        actions = self._checked(actions)
        steps.step(self.network, self.settings, self.world, self._work, self.outputs, actions)
        return self._outcome, self.observed()

    def observed(self) -> Observations:
        """Return the current observations: views of the environment's arrays."""
        outputs = self.outputs
        masks = outputs.masks if self._spec.has_action_mask else None
        return Observations(outputs.observations, outputs.states, outputs.alive, masks)

    def _redraw(self, seeds: NDArray[np.uint64]) -> None:
        """Only the supervisor draws after the start of an episode; human drivers are deterministic."""
        self.world.episodes["seed"] = self.world.episodes["key"] = seeds

    def _begin(self, seeds: NDArray[np.uint64]) -> None:
        steps.begin(self.network, self.settings, self.world, self.outputs, seeds)
