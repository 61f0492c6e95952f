"""Batched intersection of one copy, the maximum per process."""

from collections.abc import Sequence
from typing import Any, Never

import numpy as np
from numpy.typing import NDArray

from headway.contracts import Box, EnvSpec, HeadwayError, Observations, StepResult
from headway_envs.intersection import kernel
from headway_envs.intersection.episode_metrics import EpisodeMetrics
from headway_envs.intersection.layout import ACCOUNT, SCRATCH, STATE_SIZE, Slots
from headway_envs.intersection.metrics import METRICS
from headway_envs.intersection.observation import features
from headway_envs.intersection.prepared import Prepared
from headway_envs.intersection.sumo.bridge import Changes, SumoBridge
from headway_envs.intersection.sumo.scenario import OPTIONS, episode_draws
from headway_envs.step_arrays import step_arrays, step_result
from headway_envs.sumo_simulation import Simulation


class IntersectionBatchedEnv:
    """One intersection; implements `headway.contracts.BatchedEnv`.

    Agents are slots for automated vehicles (AVs). An AV takes the lowest free slot when it enters and frees
    it when it leaves or crashes; the slot can be taken again from the next step on. Actions are accelerations
    within 3 m/s^2. An AV that crashes is terminated; one that leaves ends as `at_exit` sets, with its last
    observation as final observation; at the horizon all AVs are truncated.
    """

    def __init__(self, prepared: Prepared, copies: int) -> None:
        """Allocate arrays; `reset` loads SUMO. Raises HeadwayError unless `copies` is 1."""
        if copies != 1:
            raise HeadwayError(
                f"a process can hold 1 copy of the intersection, not {copies}; set rollout.block=1, with one "
                "worker process per copy"
            )
        config = self.config = prepared.config
        self.prepared = prepared
        self._street: SumoBridge | None = None
        extended = config.observation == "extended"
        slots = self._slots = Slots.empty(config.slots, extended)
        self._account, self._scratch = np.zeros(1, ACCOUNT), np.zeros(1, SCRATCH)
        self._spec = EnvSpec(
            name="intersection",
            agents=tuple(f"av_{slot}" for slot in range(config.slots)),
            observation_size=slots.observations.shape[1],
            action_space=Box((-kernel.MAX_ACCELERATION,), (kernel.MAX_ACCELERATION,)),
            state_size=STATE_SIZE,
            shared_reward=config.reward.kind == "scaled" and config.reward.scope == "team",
            agents_come_and_go=True,
            metrics=METRICS,
            observation_features=features(prepared),
            max_copies_per_process=1,
        )
        self._actions_shape = (1, config.slots, 1)
        self.events: dict[int, str] = {}
        """`arrived` or `collided` for each slot whose vehicle left or crashed in the last step."""
        self.crash_places: list[tuple[float, float]] = []
        """Positions of crashes in the last step, (x, y) in m from the centre; empty if that step ended the
        episode."""
        self._seed, self._episode = 0, 0
        self.counters = EpisodeMetrics(config)
        self._observed = Observations(slots.observations[None], self._account["state"], slots.alive[None])
        own = {"rewards": slots.rewards[None], "acting": slots.acting[None]}
        self._outcome = step_result(step_arrays(self._spec, 1) | own)

    @property
    def spec(self) -> EnvSpec:
        return self._spec

    @property
    def num_copies(self) -> int:
        return 1

    @property
    def bridge(self) -> SumoBridge:
        """Vehicles and simulation, for rules and pictures; created at the first use."""
        if self._street is None:
            prepared = self.prepared
            simulation = Simulation(prepared.network.path, prepared.routes, OPTIONS)
            self._street = SumoBridge(prepared.config, prepared.network, simulation)
        return self._street

    @property
    def steps_taken(self) -> int:
        """Number of steps of 0.1 s taken in the current episode."""
        return self.counters.steps

    @property
    def episode(self) -> tuple[int, int]:
        """Seed of the last `reset`, and number of episodes that have ended since."""
        return self._seed, self._episode

    def observed(self) -> Observations:
        """Return the current observations: views of the environment's arrays."""
        return self._observed

    def reset(self, seeds: NDArray[np.uint64]) -> Observations:
        """Begin episode 0; seeds (1,). Raises ValueError for another shape, and HeadwayError if another
        environment of this process holds the simulation."""
        if len(seeds) != 1:
            raise ValueError(f"seeds must have shape (1,), not {np.shape(seeds)}")
        self._seed, self._episode = int(seeds[0]), 0
        self._begin()
        return self._observed

    def step(self, actions: NDArray[Any]) -> tuple[StepResult, Observations]:
        """Advance by `action_repeat` steps of 0.1 s; accelerations (1, N, 1) in m/s^2, clipped to 3.

        Rewards are summed over these steps: the team's over all of them, also for slots whose AV has left;
        the paper's and own rewards until the AV leaves. Raises ValueError for another shape of actions.
        """
        if actions.shape != self._actions_shape:
            raise ValueError(f"actions must have shape {self._actions_shape}, not {actions.shape}")
        outcome, slots = self._outcome, self._slots
        self.crash_places = []
        if self.events or outcome.episode_ended[0]:
            outcome.terminated.fill(False)
            outcome.truncated.fill(False)
            outcome.episode_ended[0] = False
            self.events = {}
        accelerations = np.ascontiguousarray(actions[0, :, 0], np.float32)
        slots.acting[:] = slots.alive
        slots.rewards.fill(0)
        for _ in range(self.config.action_repeat):
            crashed = self._advance(accelerations)
            over = crashed and self.config.on_collision == "end_episode"
            if over or self.counters.steps >= self.config.horizon:
                outcome.episode_ended[0] = True
                self._end(crashed=over)
                break
        return outcome, self._observed

    def _advance(self, accelerations: NDArray[np.float32]) -> bool:
        """Advance by one step of 0.1 s and return whether vehicles crashed."""
        counters, bridge = self.counters, self.bridge
        # AVs that entered after the action was chosen keep their speed.
        bridge.command(accelerations, self._slots.acting)
        changes = bridge.advance(counters.steps + 1, self.events)
        counters.count(changes)
        if changes.arrived or changes.crashes:
            self._end_departed(changes)
        kernel.process_step(
            bridge.crossing,
            bridge.roster.records,
            self._account,
            self._scratch,
            *self._slots,
            len(bridge.roster),
            bridge.readings,
            changes.arrived,
            changes.crashes,
            changes.lane_changes,
            counters.outflow_vph,
            changes.pending,
            counters.steps / self.config.horizon,
        )
        return changes.crashes > 0

    def snapshot(self) -> Never:
        """Raise HeadwayError: a simulation state saved by SUMO does not continue exactly."""
        raise HeadwayError("the intersection has no snapshots; its episodes restart on resume")

    def restore(self, snapshot: object) -> Never:
        """Raise HeadwayError: there are no snapshots."""
        raise HeadwayError("the intersection has no snapshots; its episodes restart on resume")

    def close(self) -> None:
        """Release the simulation for other environments of this process."""
        if self._street is not None:
            self._street.close()

    def _begin(self) -> None:
        self.counters, self.crash_places = EpisodeMetrics(self.config), []
        self._account.fill(0)
        self.bridge.begin(*episode_draws(self._seed, self._episode))
        self._slots.observations.fill(0)
        self._slots.alive.fill(False)

    def _end_departed(self, changes: Changes) -> None:
        """End the streams of AVs that left or crashed; with own rewards, charge for the crash."""
        outcome = self._outcome
        cut = self.config.at_exit == "truncated"
        self._end_streams(changes.left, "arrived", outcome.truncated if cut else outcome.terminated)
        self._end_streams(changes.crashed, "collided", outcome.terminated)
        self.crash_places += changes.places
        if self.config.reward.scope == "own":
            crashed = [slot for slot in changes.crashed if outcome.acting[0, slot]]
            outcome.rewards[0, crashed] -= self.config.reward.collision

    def _end_streams(self, slots: Sequence[int], event: str, flags: NDArray[np.bool_]) -> None:
        """End streams with their last observation. An AV that has never acted has no stream to end."""
        for slot in slots:
            self.events[slot] = event
            if self._outcome.acting[0, slot]:
                flags[0, slot] = True
                self._outcome.final_observations[0, slot] = self._slots.observations[slot]

    def _end(self, crashed: bool) -> None:
        """End the streams of all slots and begin the next episode."""
        outcome = self._outcome
        rest = ~(outcome.terminated[0] | outcome.truncated[0])
        (outcome.terminated if crashed else outcome.truncated)[0, rest] = True
        outcome.final_observations[0, rest] = self._slots.observations[rest]
        outcome.final_states[:] = self._account["state"]
        outcome.metrics[0] = self.counters.metrics(self._account[0])
        self._episode += 1
        self._begin()
