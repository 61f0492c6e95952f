"""Batched bus environment."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from headway.contracts import Box, Discrete, EnvSpec, Observations, StepResult
from headway_envs.array_env import ArrayEnv, Snapshot, copied
from headway_envs.bus.config import BusConfig
from headway_envs.bus.kernel import tick
from headway_envs.bus.kernel.allocation import allocate_trace, allocate_world, state_size
from headway_envs.bus.kernel.future import redraw
from headway_envs.bus.kernel.layout import LIMIT_NEXT, OBSERVATION_SIZES, SKIP_NEXT, Outputs, World
from headway_envs.bus.metrics import METRICS
from headway_envs.bus.observation import features
from headway_envs.bus.prepared import Prepared

_WAITING = ("arrived_at", "leaves_at")
"""Arrays of the world of which only the positions of waiting passengers are read."""


class BusBatchedEnv(ArrayEnv[World, Outputs]):
    """C service days stepped together; implements `headway.contracts.BatchedEnv`.

    Agents are vehicle slots. Actions are 0 WAIT, 1 MOVE, 2 SERVICE_CENTER or, with `control=holding`, holding
    times, then skipping and limited boarding where configured; they are latched for one control interval and
    used at each decision event in it (`acting`), at its exact time.

    With `control=holding` decisions are asynchronous: a bus decides again after k control intervals, k
    differing from decision to decision, and its actions between are not used. Rewards are paid in every
    interval. The process is semi-Markov (Sutton, Precup and Singh 1999, "Between MDPs and semi-MDPs"): a
    decision in interval t earns r_t + gamma r_{t+1} + ... + gamma^(k-1) r_{t+k-1}, and the value at the next
    one is discounted by gamma^k, gamma being the discount per control interval.

    At the end of the service day all agents are terminated, not truncated: the last buses and passengers have
    left, so actions could not influence any later reward.
    """

    _KIND = "bus scenario"

    def __init__(self, prepared: Prepared, copies: int, traced: bool = False) -> None:
        """Allocate `copies` copies.

        `traced`: record times and passengers at every call in `trace`, which keeps a finished day until the
        next step.

        Raises HeadwayError for fewer than one copy.
        """
        config, self.prepared = prepared.config, prepared
        self.network = prepared.network
        self.settings = prepared.settings
        self._spec = EnvSpec(
            name="bus",
            agents=prepared.agents,
            observation_size=OBSERVATION_SIZES[config.observation],
            action_space=_action_space(config),
            state_size=state_size(self.network, config.observation, prepared.full_state),
            groups=prepared.groups,
            shared_reward=config.reward.scope == "team",
            shared_in_groups=config.reward.scope == "line",
            has_action_mask=not config.holds or bool(config.further_actions),
            agents_come_and_go=True,
            metrics=METRICS,
            observation_features=features(prepared),
            snapshots=True,
        )
        self._kernel_actions = _kernel_actions(config)
        self.outputs = Outputs(**self._arrays(copies, Outputs._fields))
        self.world = allocate_world(self.network, copies, config.capacity)
        self.trace = allocate_trace(self.network, copies, traced)
        ends = self._arrays(copies, ("terminated", "truncated"))
        self._outcome = self._result(**ends)

    def step(self, actions: NDArray[Any]) -> tuple[StepResult, Observations]:
        """Advance by one control interval; actions (C, N) int64 of 0 to 2. With `control=holding`, numbers of
        `hold_levels` and of the actions after them, or (C, N, 1) float32 of holding times, s, which are
        clipped to [0, `max_hold_s`] and rounded to milliseconds.

        A bus that is away or broken down ignores its action; SERVICE_CENTER acts as MOVE if the centre does
        not accept the bus. Skipping and limited boarding act as a holding time of 0 where the bus may not
        do that at its decision.

        Raises ValueError for any other shape of actions.
        """
        config = self.prepared.config
        if isinstance(self._spec.action_space, Box):
            actions = np.rint(1000.0 * np.clip(actions, 0.0, config.max_hold_s).astype(np.float64))
            actions = actions.squeeze(-1) if actions.shape[-1:] == (1,) else actions
        actions = self._checked(actions)
        if self._kernel_actions is not None:
            actions = self._kernel_actions[actions]
        outputs = self.outputs
        if tick.step(self.network, self.settings, self.world, outputs, actions, self.trace):
            tick.start_next_days(self.network, self.settings, self.world, outputs)
        self._outcome.terminated[...] = outputs.ended[:, None]
        return self._outcome, self.observed()

    def observed(self) -> Observations:
        """Return the current observations, states, alive mask and action masks.

        They are views of the environment's arrays.
        """
        outputs = self.outputs
        masks = outputs.masks if self._spec.has_action_mask else None
        return Observations(outputs.observations, outputs.states, outputs.alive, masks)

    def snapshot(self) -> Snapshot:
        """Return copies of all arrays.

        Queue storage, most of a city's state, is copied at occupied positions only: workers send a snapshot
        to the learner at every iteration, and every checkpoint contains one.
        """
        occupied, rest = self._occupied(self.world.queues["waiting"]), self.world._asdict()
        waiting = {name: rest.pop(name).ravel()[occupied] for name in _WAITING}
        return {"world": {**copied(rest), **waiting}, "outputs": copied(self.outputs._asdict())}

    def restore(self, snapshot: Snapshot) -> Observations:
        """Continue from a snapshot and return its observations.

        Raises HeadwayError if the scenario or the number of copies differs.
        """
        world, queues = dict(snapshot["world"]), np.zeros_like(self.world.queues)
        if "queues" in world and world["queues"].shape == queues.view(np.uint8).shape:
            queues.view(np.uint8)[...] = world["queues"]
            occupied = self._occupied(np.minimum(queues["waiting"], np.diff(self.network.queue_first)))
            for name in _WAITING:
                # Older checkpoints also hold the unoccupied positions and need no unpacking.
                if name in world and world[name].shape == occupied.shape:
                    full = np.zeros_like(getattr(self.world, name))
                    full.ravel()[occupied] = world[name]
                    world[name] = full
        return super().restore({**snapshot, "world": world})

    def _redraw(self, seeds: NDArray[np.uint64]) -> None:
        redraw(self.network, self.settings, self.world, seeds)

    def _occupied(self, waiting: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the occupied positions of the flattened queue storage (C x storage).

        `waiting` (C, Q): numbers of waiting passengers.
        """
        first, counts = self.network.queue_first, waiting.ravel()
        begins = (np.arange(self.num_copies)[:, None] * first[-1] + first[:-1]).ravel()
        before = np.cumsum(counts) - counts
        return np.repeat(begins - before, counts) + np.arange(counts.sum())

    def _begin(self, seeds: NDArray[np.uint64]) -> None:
        tick.begin(self.network, self.settings, self.world, self.outputs, seeds)


def _action_space(config: BusConfig) -> Discrete | Box:
    if not config.holds:
        return Discrete(3)
    if not config.hold_levels:
        return Box((0.0,), (config.max_hold_s,))
    return Discrete(config.hold_levels + len(config.further_actions))


def _kernel_actions(config: BusConfig) -> NDArray[np.int64] | None:
    """Return what each Discrete action is to the kernel, if that is not its number: a holding time, ms,
    SKIP_NEXT or LIMIT_NEXT."""
    if not config.holds or not config.hold_levels:
        return None
    times = np.rint(1000.0 * config.hold_step_s * np.arange(config.hold_levels)).astype(np.int64)
    further = [{"skip": SKIP_NEXT, "limit": LIMIT_NEXT}[name] for name in config.further_actions]
    return np.append(times, np.array(further, np.int64))
