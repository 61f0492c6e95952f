"""Batched intersection of one copy, the maximum per process."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from headway.contracts import Box, EnvSpec, Observations, StepResult
from headway.contracts.environment import step_arrays, step_result
from headway_envs import platoons
from headway_envs.intersection import kernel
from headway_envs.intersection.config import CLEAR_S, GREEN_S, STEP_S
from headway_envs.intersection.episode_metrics import EpisodeMetrics
from headway_envs.intersection.layout import ACCOUNT, NUM_LANES, SCRATCH, STATE_SIZE, Slots
from headway_envs.intersection.metrics import METRICS
from headway_envs.intersection.network import ROAD_M, SPEED_LIMIT
from headway_envs.intersection.observation import features
from headway_envs.intersection.prepared import Prepared
from headway_envs.intersection.sumo.bridge import Changes, SumoBridge
from headway_envs.intersection.sumo.scenario import OPTIONS, episode_draws
from headway_envs.sumo_env import SumoEnv

_OTHER_LANES = (np.arange(NUM_LANES)[:, None] + np.arange(1, NUM_LANES)) % NUM_LANES
"""(8, 7) entry lanes besides each one, clockwise."""


class IntersectionBatchedEnv(SumoEnv):
    """One intersection; implements `headway.contracts.BatchedEnv`.

    Agents are slots for automated vehicles (AVs). An AV takes the lowest free slot when it enters and frees
    it when it leaves or crashes; the slot can be taken again from the next step on. Actions are accelerations
    within 3 m/s^2. An AV that crashes is terminated; one that leaves ends as `at_exit` sets, with its last
    observation as final observation; at the horizon all AVs are truncated.
    """

    def __init__(self, prepared: Prepared, copies: int) -> None:
        """Allocate arrays; `reset` loads SUMO. Raises HeadwayError unless `copies` is 1."""
        super().__init__("the intersection", copies, prepared.network.path, OPTIONS)
        config = self.config = prepared.config
        self.prepared = prepared
        self._bridge: SumoBridge | None = None
        described = features(prepared)
        slots = self._slots = Slots.empty(config.slots, len(described))
        self._account, self._scratch = np.zeros(1, ACCOUNT), np.zeros(1, SCRATCH)
        self._spec = EnvSpec(
            name="intersection",
            agents=tuple(f"av_{slot}" for slot in range(config.slots)),
            observation_size=len(described),
            action_space=Box((-kernel.MAX_ACCELERATION,), (kernel.MAX_ACCELERATION,)),
            state_size=STATE_SIZE,
            shared_reward=config.reward.kind == "scaled" and config.reward.scope == "team",
            agents_come_and_go=True,
            metrics=METRICS,
            observation_features=described,
            max_copies_per_process=1,
        )
        self._actions_shape = (1, config.slots, 1)
        self.events: dict[int, str] = {}
        """`arrived` or `collided` for each slot whose vehicle left or crashed in the last step."""
        self.crash_places: list[tuple[float, float]] = []
        """Positions of crashes in the last step, (x, y) in m from the centre; empty if that step ended the
        episode."""
        self.counters = EpisodeMetrics(config)
        self._observed = Observations(slots.observations[None], self._account["state"], slots.alive[None])
        own = {"rewards": slots.rewards[None], "acting": slots.acting[None]}
        self._outcome = step_result(step_arrays(self._spec, 1) | own)

    @property
    def bridge(self) -> SumoBridge:
        """Vehicles and simulation, for rules and pictures; created at the first use."""
        if self._bridge is None:
            self._bridge = SumoBridge(self.config, self.prepared.network, self.simulation)
        return self._bridge

    @property
    def steps_taken(self) -> int:
        """Number of steps of 0.1 s taken in the current episode."""
        return self.counters.steps

    def step(self, actions: NDArray[Any]) -> tuple[StepResult, Observations]:
        """Advance by `action_repeat` steps of 0.1 s; accelerations (1, N, 1) in m/s^2, clipped to 3.

        Rewards are summed over these steps: the team's over all of them, also for slots whose AV has left;
        the paper's and own rewards until the AV leaves. Raises ValueError for another shape of actions.
        """
        if actions.shape != self._actions_shape:
            raise ValueError(f"actions must have shape {self._actions_shape}, not {actions.shape}")
        self._begin_step()
        self.events, self.crash_places = {}, []
        accelerations = np.ascontiguousarray(actions[0, :, 0], np.float32)
        self._slots.rewards.fill(0)
        for _ in range(self.config.action_repeat):
            crashed = self._advance(accelerations)
            over = crashed and self.config.on_collision == "end_episode"
            if over or self.counters.steps >= self.config.horizon:
                self._end_episode(terminated=over)
                break
        return self._outcome, self._observed

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
        if self.config.observation == "platoons":
            self._observe_platoons()
        if self.config.clock:
            self._observe_clock()
        return changes.crashes > 0

    def _observe_platoons(self) -> None:
        count, traffic = len(self.bridge.roster), self.bridge.roster.traffic
        lane, distance = traffic.link[:count] // 2, ROAD_M - traffic.position[:count]
        platoons.observe(
            np.lexsort((distance, lane)),
            lane,
            distance,
            traffic.speed[:count],
            traffic.slot[:count],
            _OTHER_LANES,
            ROAD_M,
            SPEED_LIMIT,
            3 * NUM_LANES - 1,
            np.zeros(count, np.int64),
            np.zeros(NUM_LANES, np.int64),
            self._slots.observations,
            self._slots.alive,
        )

    def _observe_clock(self) -> None:
        count, traffic = len(self.bridge.roster), self.bridge.roster.traffic
        slots, half_s = traffic.slot[:count], GREEN_S + CLEAR_S
        turns = self.steps_taken * STEP_S / half_s - traffic.link[:count] // 4 % 2
        there = slots >= 0
        angles = np.pi * turns[there]
        self._slots.observations[slots[there], -2:] = np.column_stack((np.sin(angles), np.cos(angles)))

    def _begin(self) -> None:
        self.counters, self.crash_places = EpisodeMetrics(self.config), []
        self._account.fill(0)
        seed, draw = episode_draws(*self.episode)
        self.bridge.begin(seed, self.prepared.routes, draw)
        self._slots.observations.fill(0)
        self._slots.alive.fill(False)

    def _end_departed(self, changes: Changes) -> None:
        """End the streams of AVs that left or crashed; with own rewards, charge for the crash."""
        outcome = self._outcome
        cut = self.config.at_exit == "truncated"
        self._end_streams(changes.left, outcome.truncated if cut else outcome.terminated)
        self._end_streams(changes.crashed, outcome.terminated)
        self.events |= dict.fromkeys(changes.left, "arrived") | dict.fromkeys(changes.crashed, "collided")
        self.crash_places += changes.places
        if self.config.reward.scope == "own":
            crashed = [slot for slot in changes.crashed if outcome.acting[0, slot]]
            outcome.rewards[0, crashed] -= self.config.reward.collision

    def _metrics(self) -> Sequence[float]:
        return self.counters.metrics(self._account[0])
