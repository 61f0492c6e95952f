"""The rule `lookahead`: one step of policy improvement over a base rule, by simulation."""

from collections.abc import Callable
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from headway.contracts import (
    BatchedEnv,
    BranchingEnv,
    Discrete,
    HeadwayError,
    Observations,
    Rule,
    generator,
)
from headway.contracts.entries import LOOKAHEAD

STEPS, SAMPLES = 30, 8
"""Default horizon, in environment steps, and number of simulated futures."""
_BATCH_SIZES = (16, 8, 4, 2, 1)
"""Numbers of joint actions simulated in one batch."""
_MARGIN = 2.0
"""Number of standard errors by which an action must do better than the one it replaces. Without a margin,
chance differences would undo many decisions of the base rule."""


class Lookahead:
    """Takes the actions with the best simulated returns, with the base rule acting from the next step on.

    Agents choose one after another: each allowed action of an agent is simulated together with the choices of
    the agents before it and the base rule's actions of the agents behind it. An action is taken if its mean
    return over simulated futures of `steps` steps is higher by more than chance. All joint actions of a step
    are simulated in the same futures (common random numbers). The rule draws these futures: it knows the
    dynamics and the present state, not what will happen.

    Source: rollout, Bertsekas, "Reinforcement Learning and Optimal Control" (2019), section 2.4; agent by
    agent: Bertsekas 2020, arXiv:1910.00120.
    """

    def __init__(
        self, make: Callable[[Any, int], BatchedEnv], prepared: object, base: Rule, steps: int, samples: int
    ) -> None:
        """`make` is that of the environment's entry; its batches are `BranchingEnv`s. `base` must not draw
        random numbers: futures would then differ between joint actions."""
        self._make, self._prepared, self._base = make, prepared, base
        self._steps, self._samples = steps, samples
        self._batches: dict[int, BranchingEnv] = {}
        self._draw = generator(0, LOOKAHEAD)

    def act(self, env: BatchedEnv, observed: Observations) -> NDArray[np.int64]:
        """Return the actions (C, N). Raises HeadwayError unless the action space is Discrete."""
        space = env.spec.action_space
        if not isinstance(space, Discrete):
            raise HeadwayError(
                f"rule {LOOKAHEAD} tries every action, and {env.spec.name} has no Discrete space; leave it "
                "out"
            )
        actions = np.array(self._base.act(env, observed), np.int64)
        untried = np.arange(space.n) != actions[..., None]
        untried &= observed.alive[..., None]
        if observed.action_masks is not None:
            untried &= observed.action_masks
        rows = np.flatnonzero(untried.any(axis=(1, 2)))
        futures = self._draw.integers(2**63, size=self._samples).astype(np.uint64)
        values = np.zeros((env.num_copies, self._samples))
        values[rows], acting = self._simulate(env, rows, actions[rows], futures)
        # Agents whose action the environment would ignore have nothing to choose.
        untried[rows] &= acting[..., None]
        for agent in range(env.spec.num_agents):
            copies, choices = np.nonzero(untried[:, agent])
            tried = actions[copies]
            tried[:, agent] = choices
            returns, _ = self._simulate(env, copies, tried, futures)
            for copy, choice, value in zip(copies, choices, returns, strict=True):
                if _is_better(value - values[copy]):
                    values[copy], actions[copy, agent] = value, choice
        return actions

    def _simulate(
        self,
        env: BatchedEnv,
        rows: NDArray[np.int64],
        actions: NDArray[np.int64],
        futures: NDArray[np.uint64],
    ) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """Return the returns (J, S) of J joint actions (J, N) in copies `rows` (J,) of `env`, in S futures.

        Also return which agents acted in any future's first step, (J, N).
        """
        returns, acting = np.zeros((len(rows), self._samples)), np.zeros(actions.shape, np.bool_)
        begin = 0
        while begin < len(rows):
            size = next(size for size in _BATCH_SIZES if begin + size <= len(rows))
            part = slice(begin, begin + size)
            returns[part], acting[part] = self._simulate_batch(env, rows[part], actions[part], futures)
            begin += size
        return returns, acting

    def _simulate_batch(
        self,
        env: BatchedEnv,
        rows: NDArray[np.int64],
        actions: NDArray[np.int64],
        futures: NDArray[np.uint64],
    ) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        size, samples = len(rows), self._samples
        if size not in self._batches:
            self._batches[size] = cast(BranchingEnv, self._make(self._prepared, size * samples))
        batch = self._batches[size]
        batch.branch_from(env, np.repeat(rows, samples), np.tile(futures, size))
        outcome, observed = batch.step(np.repeat(actions, samples, axis=0))
        acting = np.asarray(outcome.acting.reshape(size, samples, -1).any(axis=1))
        returns = outcome.rewards.mean(axis=1, dtype=np.float64)
        running = ~outcome.episode_ended
        for _ in range(self._steps - 1):
            if not running.any():
                break
            outcome, observed = batch.step(self._base.act(batch, observed))
            returns += running * outcome.rewards.mean(axis=1, dtype=np.float64)
            running &= ~outcome.episode_ended
        return returns.reshape(size, samples), acting


def _is_better(differences: NDArray[np.float64]) -> bool:
    """Return whether paired differences of returns (S,) are on average more than `_MARGIN` standard errors
    above 0."""
    error = differences.std() / max(len(differences) - 1, 1) ** 0.5
    return bool(differences.mean() > _MARGIN * error)
