"""The batched face of the merging environments."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from headway.contracts import Discrete, EnvSpec, HeadwayError, Observed, Outcome
from headway_envs.kept_arrays import Snapshot, put_back, snapshot_of
from headway_envs.merge.kernel import steps
from headway_envs.merge.kernel.layout import (
    ACTIONS,
    CAR,
    CAR_STATE,
    EPISODE,
    FORESEEN,
    METRICS,
    OBSERVATION_SIZE,
    Outputs,
    Workspace,
    World,
)
from headway_envs.merge.prepared import Prepared


class MergeBatchedEnv:
    """C merges stepped together; implements `headway.contracts.BatchedEnv`.

    Agents are slots of CAVs, of which an episode fills the first few (`alive`), all of it. Actions are 0
    change to the left, 1 idle, 2 change to the right, 3 faster, 4 slower, for 0.2 s. The episode ends for all
    when a CAV crashes (terminated) or the time is over (truncated; terminated with the preset `paper`).
    Vehicles that come to the end of the road drive on.
    """

    def __init__(self, prepared: Prepared, copies: int) -> None:
        """Raises HeadwayError if there is not at least one copy."""
        if copies < 1:
            raise HeadwayError(f"copies must be at least 1, not {copies}")
        config, self.prepared, self.network = prepared.config, prepared, prepared.network
        slots, cars = len(prepared.agents), prepared.vehicles
        state = CAR_STATE * cars + 1
        self.settings = prepared.settings
        self.world = World(
            episodes=np.zeros(copies, EPISODE),
            cars=np.zeros((copies, cars + len(self.network.obstacles)), CAR),
        )
        self.outputs = Outputs(
            observations=np.zeros((copies, slots, OBSERVATION_SIZE), np.float32),
            states=np.zeros((copies, state), np.float32),
            alive=np.zeros((copies, slots), np.bool_),
            masks=np.ones((copies, slots, ACTIONS), np.bool_),
            rewards=np.zeros((copies, slots), np.float32),
            acting=np.zeros((copies, slots), np.bool_),
            terminated=np.zeros((copies, slots), np.bool_),
            truncated=np.zeros((copies, slots), np.bool_),
            ended=np.zeros(copies, np.bool_),
            final_observations=np.zeros((copies, slots, OBSERVATION_SIZE), np.float32),
            final_states=np.zeros((copies, state), np.float32),
            final_episodes=np.zeros(copies, EPISODE),
            final_cars=np.zeros_like(self.world.cars),
            metrics=np.zeros((copies, len(METRICS))),
        )
        self._work = Workspace(
            ghosts=np.zeros(2, CAR),
            ways=np.zeros((4, FORESEEN, 4)),
            priorities=np.zeros(slots),
            allowed=np.zeros(ACTIONS, np.bool_),
            own=np.zeros(slots, np.float32),
        )
        self._actions = np.zeros((copies, slots), np.int64)
        self._spec = EnvSpec(
            name=prepared.name,
            agents=prepared.agents,
            observation_size=OBSERVATION_SIZE,
            action_space=Discrete(ACTIONS),
            state_size=state,
            shared_reward=config.reward.scope == "global",
            has_action_mask=config.manners.masks,
            agents_come_and_go=True,
            metrics=tuple(METRICS),
            snapshots=True,
        )

    @property
    def spec(self) -> EnvSpec:
        return self._spec

    @property
    def num_copies(self) -> int:
        return len(self.world.episodes)

    def reset(self, seeds: NDArray[np.uint64]) -> Observed:
        """Begin episode 0 of every copy; seeds (C,). Raises ValueError for another shape."""
        seeds = np.ascontiguousarray(seeds, np.uint64)
        if seeds.shape != (self.num_copies,):
            raise ValueError(f"seeds must have shape ({self.num_copies},), not {seeds.shape}")
        for name, array in {**self.world._asdict(), **self.outputs._asdict()}.items():
            # The end before stays: the adapter of a ParallelEnv begins anew before the end can be drawn.
            if not name.startswith("final_"):
                array[...] = np.zeros(1, array.dtype)
        steps.begin(self.network, self.settings, self.world, self.outputs, seeds)
        return self.observed()

    def step(self, actions: NDArray[Any]) -> tuple[Outcome, Observed]:
        """0.2 s; actions (C, N) int64 of 0 to 4, or 5 from the rule that lets CAVs drive as humans do. A
        change to where there is no lane, or none that may be changed to, is ignored."""
        if np.shape(actions) != self._actions.shape:
            raise ValueError(f"actions must have shape {self._actions.shape}, not {np.shape(actions)}")
        self._actions[...] = actions
        outputs = self.outputs
        steps.step(self.network, self.settings, self.world, self._work, outputs, self._actions)
        outcome = Outcome(
            rewards=outputs.rewards,
            terminated=outputs.terminated,
            truncated=outputs.truncated,
            acting=outputs.acting,
            episode_ended=outputs.ended,
            final_observations=outputs.final_observations,
            final_states=outputs.final_states,
            metrics=outputs.metrics,
        )
        return outcome, self.observed()

    def observed(self) -> Observed:
        """What the agents face now; views of the environment's arrays."""
        outputs = self.outputs
        masks = outputs.masks if self._spec.has_action_mask else None
        return Observed(outputs.observations, outputs.states, outputs.alive, masks)

    def snapshot(self) -> Snapshot:
        return snapshot_of(self.world, self.outputs)

    def restore(self, snapshot: Snapshot) -> Observed:
        """Continue from a snapshot of the same road, density and number of copies, else HeadwayError."""
        put_back(snapshot, self.world, self.outputs, "merge")
        return self.observed()

    def close(self) -> None:
        """Nothing is held open."""
