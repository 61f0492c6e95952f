"""Agents that come and go, to try every mask: whoever reads a row it should not reads NaN.

A visitor that is present is shown the worth of some options and, when it is ready, takes one of those
allowed to it and is paid its worth. Visitors leave and return; some retire early, for good; episodes
differ in length and end by termination or by truncation.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from headway.contracts import BatchedEnv, Discrete, EnvSpec, Observations, StepResult, generator
from headway.contracts.checks import require_at_least

OPTIONS = 3
LEAVE, RETURN, READY, RETIRE = 0.15, 0.3, 0.7, 0.3
"""Chances: of leaving and of returning at a step, of being ready at a step, of retiring in an episode."""


@dataclass(frozen=True)
class VisitorsConfig:
    """Size. The best return is the sum of the best allowed options: metric `regret` is 0."""

    agents: int = 6
    """N: slots for visitors."""
    steps: int = 60
    """Longest episode; each draws its own length, at least half of it."""

    def __post_init__(self) -> None:
        require_at_least(1, agents=self.agents)
        require_at_least(2, steps=self.steps)


@dataclass(frozen=True, slots=True)
class _Episode:
    """All that happens in one episode but for the choices; arrays of steps + 1 rows."""

    length: int
    natural: bool
    """It ends by termination, not by truncation."""
    worth: NDArray[np.float32]
    """(steps + 1, N, OPTIONS), between 0 and 1."""
    allowed: NDArray[np.bool_]
    """(steps + 1, N, OPTIONS), at least one in a row."""
    ready: NDArray[np.bool_]
    """(steps + 1, N)"""
    alive: NDArray[np.bool_]
    """(steps + 1, N)"""
    retired: NDArray[np.bool_]
    """(steps + 1, N): the agent has retired, at this step or before."""


def _draw(config: VisitorsConfig, seed: int, episode: int) -> _Episode:
    draw = generator(seed, "visitors", episode)
    shape = (config.steps + 1, config.agents)
    length = int(draw.integers((config.steps + 1) // 2, config.steps + 1))
    natural = bool(draw.random() < 0.5)
    worth = draw.random((*shape, OPTIONS), dtype=np.float32)
    allowed = draw.random((*shape, OPTIONS)) < 0.6
    sure = draw.integers(0, OPTIONS, shape)
    allowed |= sure[..., None] == np.arange(OPTIONS)
    ready = draw.random(shape) < READY
    chance = draw.random(shape)
    alive = np.zeros(shape, dtype=np.bool_)
    alive[0] = chance[0] < 0.7
    for step in range(1, len(alive)):
        alive[step] = np.where(alive[step - 1], chance[step] >= LEAVE, chance[step] < RETURN)
    retired = np.zeros(shape, dtype=np.bool_)
    when = draw.integers(1, config.steps + 1, config.agents)
    for agent in np.flatnonzero(draw.random(config.agents) < RETIRE):
        if alive[when[agent] - 1, agent]:
            retired[when[agent] :, agent] = True
    return _Episode(length, natural, worth, allowed, ready, alive & ~retired, retired)


class Visitors:
    """C copies. Observation: the options' worth, then 1 if ready (D = 4); state: who is there, and the
    share of the longest episode that has passed (S = N + 1). Rows of absent agents are NaN, masks False."""

    def __init__(self, config: VisitorsConfig, copies: int) -> None:
        self._config, n = config, config.agents
        self._spec = EnvSpec(
            name="visitors",
            agents=tuple(f"visitor_{index}" for index in range(n)),
            observation_size=OPTIONS + 1,
            action_space=Discrete(OPTIONS),
            state_size=n + 1,
            has_action_mask=True,
            agents_come_and_go=True,
            metrics=("regret", "disallowed", "choices"),
            snapshots=True,
        )
        self._seeds = np.zeros(copies, dtype=np.uint64)
        self._numbers = np.zeros(copies, dtype=np.int64)
        self._steps = np.zeros(copies, dtype=np.int64)
        self._sums = np.zeros((copies, 3))
        self._episodes: list[_Episode] = []
        self._masks = np.zeros((copies, n, OPTIONS), dtype=np.bool_)
        self._observed = Observations(
            observations=np.zeros((copies, n, OPTIONS + 1), dtype=np.float32),
            states=np.zeros((copies, n + 1), dtype=np.float32),
            alive=np.zeros((copies, n), dtype=np.bool_),
            action_masks=self._masks,
        )
        self._outcome = StepResult(
            rewards=np.zeros((copies, n), dtype=np.float32),
            terminated=np.zeros((copies, n), dtype=np.bool_),
            truncated=np.zeros((copies, n), dtype=np.bool_),
            acting=np.zeros((copies, n), dtype=np.bool_),
            episode_ended=np.zeros(copies, dtype=np.bool_),
            final_observations=np.zeros((copies, n, OPTIONS + 1), dtype=np.float32),
            final_states=np.zeros((copies, n + 1), dtype=np.float32),
            metrics=np.zeros((copies, 3), dtype=np.float64),
        )

    @property
    def spec(self) -> EnvSpec:
        return self._spec

    @property
    def num_copies(self) -> int:
        return len(self._seeds)

    def reset(self, seeds: NDArray[np.uint64]) -> Observations:
        self._seeds[:] = seeds
        self._numbers.fill(0)
        self._steps.fill(0)
        self._sums.fill(0)
        return self._redraw()

    def step(self, actions: NDArray[Any]) -> tuple[StepResult, Observations]:
        outcome = self._outcome
        outcome.final_observations.fill(np.nan)
        outcome.final_states.fill(np.nan)
        for copy in range(self.num_copies):
            self._pay(copy, actions[copy])
            self._advance(copy)
            self._show(copy)
        return outcome, self._observed

    def snapshot(self) -> tuple[NDArray[Any], ...]:
        return self._seeds.copy(), self._numbers.copy(), self._steps.copy(), self._sums.copy()

    def restore(self, snapshot: tuple[NDArray[Any], ...]) -> Observations:
        mine = (self._seeds, self._numbers, self._steps, self._sums)
        for array, saved in zip(mine, snapshot, strict=True):
            array[:] = saved
        return self._redraw()

    def close(self) -> None:
        pass

    def _redraw(self) -> Observations:
        numbers = zip(self._seeds.tolist(), self._numbers.tolist(), strict=True)
        self._episodes = [_draw(self._config, seed, number) for seed, number in numbers]
        for copy in range(self.num_copies):
            self._show(copy)
        return self._observed

    def _pay(self, copy: int, actions: NDArray[Any]) -> None:
        """A choice that is not allowed costs 1."""
        episode, step = self._episodes[copy], int(self._steps[copy])
        worth, allowed = episode.worth[step], episode.allowed[step]
        acting = episode.alive[step] & episode.ready[step]
        agents = np.arange(self._config.agents)
        chosen = np.where(acting, actions, 0)
        legal = allowed[agents, chosen]
        rewards = np.where(acting, np.where(legal, worth[agents, chosen], -1.0), 0.0)
        best = np.where(allowed, worth, 0).max(axis=-1)
        self._outcome.acting[copy] = acting
        self._outcome.rewards[copy] = rewards
        self._sums[copy] += (best - rewards)[acting].sum(), (acting & ~legal).sum(), acting.sum()

    def _advance(self, copy: int) -> None:
        outcome, episode = self._outcome, self._episodes[copy]
        self._steps[copy] += 1
        step = int(self._steps[copy])
        ended = step == episode.length
        retiring = episode.retired[step] & ~episode.retired[step - 1]
        over = episode.retired[step] | episode.natural if ended else retiring
        outcome.terminated[copy] = over
        outcome.truncated[copy] = ~over if ended else False
        outcome.episode_ended[copy] = ended
        leaving = over | ended
        outcome.final_observations[copy, leaving, :OPTIONS] = episode.worth[step, leaving]
        outcome.final_observations[copy, leaving, OPTIONS] = episode.ready[step, leaving]
        if ended:
            outcome.final_states[copy] = self._state(episode, step)
            outcome.metrics[copy] = self._sums[copy]
            self._sums[copy] = 0
            self._steps[copy] = 0
            self._numbers[copy] += 1
            self._episodes[copy] = _draw(self._config, int(self._seeds[copy]), int(self._numbers[copy]))

    def _show(self, copy: int) -> None:
        observed, episode, step = self._observed, self._episodes[copy], int(self._steps[copy])
        alive = episode.alive[step]
        observed.alive[copy] = alive
        observed.observations[copy, :, :OPTIONS] = episode.worth[step]
        observed.observations[copy, :, OPTIONS] = episode.ready[step]
        observed.observations[copy, ~alive] = np.nan
        observed.states[copy] = self._state(episode, step)
        self._masks[copy] = episode.allowed[step] & alive[:, None]

    def _state(self, episode: _Episode, step: int) -> NDArray[np.float32]:
        return np.append(episode.alive[step], step / self._config.steps).astype(np.float32)


@dataclass(frozen=True)
class OptimalVisitors:
    """The best allowed option: regret 0."""

    config: VisitorsConfig

    def act(self, env: BatchedEnv, observed: Observations) -> NDArray[np.int64]:
        """(C, N); 0 for absent agents."""
        worth = observed.observations[..., :OPTIONS]
        allowed = (
            observed.action_masks if observed.action_masks is not None else np.ones_like(worth, np.bool_)
        )
        actions: NDArray[np.int64] = np.where(allowed, worth, -1).argmax(axis=-1)
        return actions
