"""Agents that come and go, to test the use of all masks: rows that must not be read are NaN.

A present visitor observes the values of some options; when it is ready, it takes an allowed option and
receives its value. Visitors leave and return; some retire early, for good. Episodes differ in length and end
by termination or truncation.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from headway.contracts import (
    BatchedEnv,
    Discrete,
    EnvSpec,
    ObservationFeature,
    Observations,
    StepResult,
    generator,
)
from headway.contracts.checks import require_at_least
from headway_envs.toy.toy_env import ToyEnv

OPTIONS = 3
LEAVE, RETURN, READY, RETIRE = 0.15, 0.3, 0.7, 0.3
"""Probabilities of leaving, of returning and of being ready, per step, and of retiring, per episode."""


@dataclass(frozen=True)
class VisitorsConfig:
    """Size of the task. The best return is the sum of the best allowed options: metric `regret` is then 0."""

    agents: int = 6
    """Number of slots for visitors."""
    steps: int = 60
    """Maximum length of an episode; the length is drawn, from half the maximum on."""

    def __post_init__(self) -> None:
        require_at_least(1, agents=self.agents)
        require_at_least(2, steps=self.steps)


@dataclass(frozen=True, slots=True)
class _Episode:
    """Random events of one episode, with T = steps."""

    length: int
    terminates: bool
    """True: ends by termination; False: by truncation."""
    values: NDArray[np.float32]
    """(T + 1, N, OPTIONS) values of the options, between 0 and 1."""
    allowed: NDArray[np.bool_]
    """(T + 1, N, OPTIONS) action mask, at least one option per agent."""
    ready: NDArray[np.bool_]
    """(T + 1, N) whether the agent acts if present."""
    alive: NDArray[np.bool_]
    """(T + 1, N) whether the agent is present."""
    retired: NDArray[np.bool_]
    """(T + 1, N) whether the agent has retired, at this step or before."""


def _draw(config: VisitorsConfig, seed: int, episode: int) -> _Episode:
    draw = generator(seed, "visitors", episode)
    shape = (config.steps + 1, config.agents)
    length = int(draw.integers((config.steps + 1) // 2, config.steps + 1))
    terminates = bool(draw.random() < 0.5)
    values = draw.random((*shape, OPTIONS), dtype=np.float32)
    allowed = draw.random((*shape, OPTIONS)) < 0.6
    guaranteed = draw.integers(0, OPTIONS, shape)
    allowed |= guaranteed[..., None] == np.arange(OPTIONS)
    ready = draw.random(shape) < READY
    chance = draw.random(shape)
    alive = np.zeros(shape, dtype=np.bool_)
    alive[0] = chance[0] < 0.7
    for step in range(1, len(alive)):
        alive[step] = np.where(alive[step - 1], chance[step] >= LEAVE, chance[step] < RETURN)
    retired = np.zeros(shape, dtype=np.bool_)
    retirement = draw.integers(1, config.steps + 1, config.agents)
    for agent in np.flatnonzero(draw.random(config.agents) < RETIRE):
        if alive[retirement[agent] - 1, agent]:
            retired[retirement[agent] :, agent] = True
    return _Episode(length, terminates, values, allowed, ready, alive & ~retired, retired)


class Visitors(ToyEnv):
    """The visitors' environment in C copies.

    Observation: values of the options, then 1 if ready (D = 4). State: alive mask, and elapsed share of the
    maximum length (S = N + 1). Rows of absent agents are NaN, their masks False.
    """

    def __init__(self, config: VisitorsConfig, copies: int) -> None:
        self._config, n = config, config.agents
        spec = EnvSpec(
            name="visitors",
            agents=tuple(f"visitor_{index}" for index in range(n)),
            observation_size=OPTIONS + 1,
            action_space=Discrete(OPTIONS),
            state_size=n + 1,
            has_action_mask=True,
            agents_come_and_go=True,
            metrics=("regret", "disallowed", "choices"),
            observation_features=(
                *(
                    ObservationFeature(f"value_{option}", "reward for choosing this option, if it is allowed")
                    for option in range(OPTIONS)
                ),
                ObservationFeature("ready", "1 if the agent's choice will be used, else 0"),
            ),
            snapshots=True,
        )
        super().__init__(spec, copies)
        self._numbers = np.zeros(copies, dtype=np.int64)
        self._steps = np.zeros(copies, dtype=np.int64)
        self._sums = np.zeros((copies, 3))
        self._episodes: list[_Episode] = []

    def step(self, actions: NDArray[Any]) -> tuple[StepResult, Observations]:
        outcome = self._outcome
        outcome.final_observations.fill(np.nan)
        outcome.final_states.fill(np.nan)
        for copy in range(self.num_copies):
            self._pay(copy, actions[copy])
            self._advance(copy)
            self._show_copy(copy)
        return outcome, self._observed

    def snapshot(self) -> tuple[NDArray[Any], ...]:
        return self._seeds.copy(), self._numbers.copy(), self._steps.copy(), self._sums.copy()

    def restore(self, snapshot: tuple[NDArray[Any], ...]) -> Observations:
        mine = (self._seeds, self._numbers, self._steps, self._sums)
        for array, saved in zip(mine, snapshot, strict=True):
            array[:] = saved
        return self._redraw()

    def _begin(self, episode: int) -> None:
        self._numbers.fill(episode)
        self._steps.fill(0)
        self._sums.fill(0)
        self._redraw()

    def _show(self) -> Observations:
        return self._observed

    def _redraw(self) -> Observations:
        numbers = zip(self._seeds.tolist(), self._numbers.tolist(), strict=True)
        self._episodes = [_draw(self._config, seed, number) for seed, number in numbers]
        for copy in range(self.num_copies):
            self._show_copy(copy)
        return self._observed

    def _pay(self, copy: int, actions: NDArray[Any]) -> None:
        """Fill the rewards of a copy; a choice that is not allowed receives -1."""
        episode, step = self._episodes[copy], int(self._steps[copy])
        values, allowed = episode.values[step], episode.allowed[step]
        acting = episode.alive[step] & episode.ready[step]
        agents = np.arange(self._config.agents)
        chosen = np.where(acting, actions, 0)
        legal = allowed[agents, chosen]
        rewards = np.where(acting, np.where(legal, values[agents, chosen], -1.0), 0.0)
        best = np.where(allowed, values, 0).max(axis=-1)
        self._outcome.acting[copy] = acting
        self._outcome.rewards[copy] = rewards
        self._sums[copy] += (best - rewards)[acting].sum(), (acting & ~legal).sum(), acting.sum()

    def _advance(self, copy: int) -> None:
        outcome, episode = self._outcome, self._episodes[copy]
        self._steps[copy] += 1
        step = int(self._steps[copy])
        ended = step == episode.length
        retiring = episode.retired[step] & ~episode.retired[step - 1]
        over = episode.retired[step] | episode.terminates if ended else retiring
        outcome.terminated[copy] = over
        outcome.truncated[copy] = ~over if ended else False
        outcome.episode_ended[copy] = ended
        leaving = over | ended
        outcome.final_observations[copy, leaving, :OPTIONS] = episode.values[step, leaving]
        outcome.final_observations[copy, leaving, OPTIONS] = episode.ready[step, leaving]
        if ended:
            outcome.final_states[copy] = self._state(episode, step)
            outcome.metrics[copy] = self._sums[copy]
            self._sums[copy] = 0
            self._steps[copy] = 0
            self._numbers[copy] += 1
            self._episodes[copy] = _draw(self._config, int(self._seeds[copy]), int(self._numbers[copy]))

    def _show_copy(self, copy: int) -> None:
        observed, episode, step = self._observed, self._episodes[copy], int(self._steps[copy])
        alive = episode.alive[step]
        observed.alive[copy] = alive
        observed.observations[copy, :, :OPTIONS] = episode.values[step]
        observed.observations[copy, :, OPTIONS] = episode.ready[step]
        observed.observations[copy, ~alive] = np.nan
        observed.states[copy] = self._state(episode, step)
        assert observed.action_masks is not None
        observed.action_masks[copy] = episode.allowed[step] & alive[:, None]

    def _state(self, episode: _Episode, step: int) -> NDArray[np.float32]:
        return np.append(episode.alive[step], step / self._config.steps).astype(np.float32)


@dataclass(frozen=True)
class OptimalVisitors:
    """Takes the best allowed option: regret 0."""

    config: VisitorsConfig

    def act(self, env: BatchedEnv, observed: Observations) -> NDArray[np.int64]:
        """Return the actions (C, N); 0 for absent agents."""
        values = observed.observations[..., :OPTIONS]
        allowed = (
            observed.action_masks if observed.action_masks is not None else np.ones_like(values, np.bool_)
        )
        actions: NDArray[np.int64] = np.where(allowed, values, -1).argmax(axis=-1)
        return actions
