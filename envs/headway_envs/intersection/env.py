"""The batched face of the intersection: one copy, which is all that a process can hold."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from headway.contracts import Box, EnvSpec, HeadwayError, Observations, StepResult, generator
from headway_envs.intersection import kernel
from headway_envs.intersection.config import STEP_S, IntersectionConfig
from headway_envs.intersection.episode_metrics import METRICS, EpisodeMetrics
from headway_envs.intersection.layout import ACCOUNT, SCRATCH, STATE_SIZE, Slots
from headway_envs.intersection.prepared import Prepared
from headway_envs.intersection.sumo.bridge import Changes, SumoBridge
from headway_envs.intersection.sumo.simulation import Simulation


def paid_share(config: IntersectionConfig) -> bool:
    """Whether the team's reward stands in every slot."""
    return config.reward.kind == "scaled" and config.reward.scope == "team"


class IntersectionBatchedEnv:
    """One crossing; implements `headway.contracts.BatchedEnv`.

    Agents are slots for automated vehicles: one that enters takes the lowest free slot, and leaves it when it
    leaves the road or crashes; another may have it from the next step on. Actions are accelerations within 3
    m/s^2. A vehicle that crashes is terminated; one that leaves ends as `at_exit` says, with what it observed
    last; at the horizon all are truncated.
    """

    def __init__(self, prepared: Prepared, copies: int) -> None:
        """Raises HeadwayError unless `copies` is 1. SUMO is loaded by `reset`."""
        if copies != 1:
            raise HeadwayError(
                f"a process can hold 1 copy of the intersection, not {copies}; let rollout.block=1, with a "
                "worker process for each copy"
            )
        config = self.config = prepared.config
        self.prepared = prepared
        self._street: SumoBridge | None = None
        extended = config.observation == "extended"
        slots = self._slots = Slots.empty(config.slots, extended)
        self._account, self._scratch = np.zeros(1, ACCOUNT), np.zeros(1, SCRATCH)
        size = slots.observations.shape[1]
        self._spec = EnvSpec(
            name="intersection",
            agents=tuple(f"av_{slot}" for slot in range(config.slots)),
            observation_size=size,
            action_space=Box((-kernel.STRONGEST,), (kernel.STRONGEST,)),
            state_size=STATE_SIZE,
            shared_reward=paid_share(config),
            agents_come_and_go=True,
            metrics=METRICS,
            max_copies_per_process=1,
        )
        self._asked = (1, config.slots, 1)
        self.events: dict[int, str] = {}
        """Slots whose vehicle left or crashed in the last step: `arrived` or `collided`."""
        self.crash_places: list[tuple[float, float]] = []
        """Where vehicles crashed in the last step of the running episode, (x, y) in m from the centre; none
        once a step has ended it."""
        self._seed, self._episode = 0, 0
        self.ledger = EpisodeMetrics(config)
        self._observed = Observations(slots.observations[None], self._account["state"], slots.alive[None])
        flags = [np.zeros((1, config.slots), np.bool_) for _ in range(2)]
        self._outcome = StepResult(
            rewards=slots.rewards[None],
            terminated=flags[0],
            truncated=flags[1],
            acting=slots.acting[None],
            episode_ended=np.zeros(1, np.bool_),
            final_observations=np.zeros((1, config.slots, size), np.float32),
            final_states=np.zeros((1, STATE_SIZE), np.float32),
            metrics=np.zeros((1, len(METRICS))),
        )

    @property
    def spec(self) -> EnvSpec:
        return self._spec

    @property
    def num_copies(self) -> int:
        return 1

    @property
    def street(self) -> SumoBridge:
        """The vehicles, for rules and pictures; there is one from the first `reset` on."""
        if self._street is None:
            prepared = self.prepared
            simulation = Simulation(prepared.network.path, prepared.routes, STEP_S)
            self._street = SumoBridge(prepared.config, prepared.network, simulation)
        return self._street

    @property
    def steps_taken(self) -> int:
        """In the running episode."""
        return self.ledger.steps

    @property
    def episode(self) -> tuple[int, int]:
        """The running one: the seed of the last `reset`, and how many episodes have ended since."""
        return self._seed, self._episode

    def observed(self) -> Observations:
        """What the agents face now."""
        return self._observed

    def reset(self, seeds: NDArray[np.uint64]) -> Observations:
        """Begin episode 0 of a seed, (1,). Raises HeadwayError where another environment of this process has
        its simulation."""
        if len(seeds) != 1:
            raise ValueError(f"seeds must have shape (1,), not {np.shape(seeds)}")
        self._seed, self._episode = int(seeds[0]), 0
        self._begin()
        return self._observed

    def step(self, actions: NDArray[Any]) -> tuple[StepResult, Observations]:
        """0.1 s, `action_repeat` times; accelerations (1, N, 1) in m/s^2, cut at 3. Rewards are sums over
        them: of the team's all, for those who have left, too; of the paper's and an own one those until one
        leaves. Raises ValueError for another shape."""
        if actions.shape != self._asked:
            raise ValueError(f"actions must have shape {self._asked}, not {actions.shape}")
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
            if over or self.ledger.steps >= self.config.horizon:
                outcome.episode_ended[0] = True
                self._end(crashed=over)
                break
        return outcome, self._observed

    def _advance(self, accelerations: NDArray[np.float32]) -> bool:
        """One step of 0.1 s; whether anybody crashed."""
        ledger, street = self.ledger, self.street
        # Who has entered since actions were asked for drives on as it came.
        street.command(accelerations, self._slots.acting)
        changes = street.advance(ledger.steps + 1, self.events)
        ledger.count(changes)
        if changes.arrived or changes.crashes:
            self._let_go(changes)
        kernel.take_in(
            street.crossing,
            street.roster.memory,
            self._account,
            self._scratch,
            *self._slots,
            len(street.roster),
            street.answers,
            changes.arrived,
            changes.crashes,
            changes.lane_changes,
            ledger.outflow_vph,
            changes.pending,
            ledger.steps / self.config.horizon,
        )
        return changes.crashes > 0

    def hand_over(self, speed_mode: int) -> None:
        """Let SUMO drive all vehicles as humans, with this speed mode; actions are ignored until the
        episode ends."""
        self.street.hand_over(speed_mode)

    def snapshot(self) -> Any:  # noqa: ANN401 - the contract's type
        """Raises HeadwayError: a state that SUMO saves does not go on exactly."""
        raise HeadwayError("the intersection has no snapshots; its episodes start anew on resume")

    def restore(self, snapshot: Any) -> Observations:  # noqa: ANN401 - the contract's type
        """Raises HeadwayError, as `snapshot`."""
        raise HeadwayError("the intersection has no snapshots; its episodes start anew on resume")

    def close(self) -> None:
        """Let another environment of this process have the simulation."""
        if self._street is not None:
            self._street.close()

    def _begin(self) -> None:
        self.ledger, self.crash_places = EpisodeMetrics(self.config), []
        self._account.fill(0)
        draw = generator(self._seed, "intersection", self._episode)
        self.street.begin(int(draw.integers(2**31 - 1)), draw)
        self._slots.observations.fill(0)
        self._slots.alive.fill(False)

    def _let_go(self, changes: Changes) -> None:
        """The streams of those who left or crashed end; own rewards charge a crash."""
        outcome = self._outcome
        cut = self.config.at_exit == "truncated"
        self._end_streams(changes.left, "arrived", outcome.truncated if cut else outcome.terminated)
        self._end_streams(changes.crashed, "collided", outcome.terminated)
        self.crash_places += changes.places
        if self.config.reward.scope == "own":
            crashed = [slot for slot in changes.crashed if outcome.acting[0, slot]]
            outcome.rewards[0, crashed] -= self.config.reward.collision

    def _end_streams(self, slots: Sequence[int], event: str, flags: NDArray[np.bool_]) -> None:
        """Streams end with what they observed last; who has never been asked had none."""
        for slot in slots:
            self.events[slot] = event
            if self._outcome.acting[0, slot]:
                flags[0, slot] = True
                self._outcome.final_observations[0, slot] = self._slots.observations[slot]

    def _end(self, crashed: bool) -> None:
        """Every slot's stream ends, and the next episode begins."""
        outcome = self._outcome
        rest = ~(outcome.terminated[0] | outcome.truncated[0])
        (outcome.terminated if crashed else outcome.truncated)[0, rest] = True
        outcome.final_observations[0, rest] = self._slots.observations[rest]
        outcome.final_states[:] = self._account["state"]
        outcome.metrics[0] = self.ledger.metrics(self._account[0])
        self._episode += 1
        self._begin()
