"""Memory task: a cue shown at the first step must be named at the last.

A policy without memory is right by chance only, because all observations are equal when the answer is due.
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


@dataclass(frozen=True)
class RecallConfig:
    """Size of the task. The best return is 1 for every agent; without memory it is 1 / `cues`."""

    agents: int = 3
    """Number of agents."""
    steps: int = 6
    """Length of an episode: the cue is shown at the first step, and the answer counts at the last."""
    cues: int = 2
    """Number of equally likely cues, and of answers."""

    def __post_init__(self) -> None:
        require_at_least(1, agents=self.agents)
        require_at_least(2, steps=self.steps, cues=self.cues)


class Recall(ToyEnv):
    """The memory task in C copies, all at the same step.

    Each agent observes its own cue (one-hot, at the first step only) and whether the answer is due (D = cues
    + 1), and receives 1 for naming its cue then.
    """

    def __init__(self, config: RecallConfig, copies: int) -> None:
        self._config, n = config, config.agents
        spec = EnvSpec(
            name="recall",
            agents=tuple(f"agent_{index}" for index in range(n)),
            observation_size=config.cues + 1,
            action_space=Discrete(config.cues),
            metrics=("recalled",),
            observation_features=(
                *(
                    ObservationFeature(f"cue_{cue}", "1 at the first step if the cue is this one, else 0")
                    for cue in range(config.cues)
                ),
                ObservationFeature("answer_due", "1 at the last step, else 0"),
            ),
            snapshots=True,
        )
        super().__init__(spec, copies)
        self._cues = np.zeros((copies, n), dtype=np.int64)

    @property
    def cues(self) -> NDArray[np.int64]:
        """(C, N) cues of the current episode."""
        return self._cues

    def step(self, actions: NDArray[Any]) -> tuple[StepResult, Observations]:
        outcome = self._outcome
        self._step += 1
        ended = self._step == self._config.steps
        outcome.terminated.fill(ended)
        outcome.episode_ended.fill(ended)
        outcome.rewards.fill(0)
        if ended:
            outcome.rewards[:] = actions == self._cues
            outcome.metrics[:, 0] = outcome.rewards.mean(axis=1)
            self._begin(self._episode + 1)
        return outcome, self._show()

    def snapshot(self) -> tuple[NDArray[np.uint64], int, int]:
        return self._seeds.copy(), self._episode, self._step

    def restore(self, snapshot: tuple[NDArray[np.uint64], int, int]) -> Observations:
        seeds, episode, step = snapshot
        self._seeds[:] = seeds
        self._begin(episode)
        self._step = step
        return self._show()

    def _begin(self, episode: int) -> None:
        self._episode, self._step = episode, 0
        for copy, seed in enumerate(self._seeds):
            draw = generator(int(seed), "recall", episode)
            self._cues[copy] = draw.integers(0, self._config.cues, self._config.agents)

    def _show(self) -> Observations:
        observations = self._observed.observations
        observations.fill(0)
        if self._step == 0:
            np.put_along_axis(observations, self._cues[..., None], 1, axis=-1)
        observations[..., -1] = self._step == self._config.steps - 1
        return self._observed


@dataclass(frozen=True)
class OptimalRecall:
    """Names the cue at every step: returns 1."""

    config: RecallConfig

    def act(self, env: BatchedEnv, observed: Observations) -> NDArray[np.int64]:
        """Return the actions (C, N). Raises TypeError for any other environment."""
        if not isinstance(env, Recall):
            raise TypeError("the optimal rule of 'recall' reads the cues of a Recall")
        return env.cues.copy()
