"""Play of native environments by rules or by one action, repeated."""

from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from headway.contracts import BatchedEnv, Observations, Rule, StepResult

Env = TypeVar("Env", bound=BatchedEnv)


def begun(env: Env, seed: int = 0) -> Env:
    """Return the environment after its reset, copy i with seed + i."""
    env.reset(np.arange(seed, seed + env.num_copies, dtype=np.uint64))
    return env


def repeated(env: BatchedEnv, action: int, steps: int) -> StepResult:
    """Return the result of the last of some steps in which every agent takes the same action."""
    for _ in range(steps):
        outcome, _ = env.step(np.full((env.num_copies, env.spec.num_agents), action, np.int64))
    return outcome


def first_episodes(env: BatchedEnv, rule: Rule, observed: Observations) -> dict[str, NDArray[np.float64]]:
    """Return the metrics, (C,) each, of every copy's first episode, played by a rule."""
    metrics = np.full((env.num_copies, len(env.spec.metrics)), np.nan)
    going = np.ones(env.num_copies, np.bool_)
    while going.any():
        outcome, observed = env.step(rule.act(env, observed))
        new = going & outcome.episode_ended
        metrics[new] = outcome.metrics[new]
        going &= ~new
    return dict(zip(env.spec.metrics, metrics.T, strict=True))


def assert_allowed(actions: NDArray[np.int64], observed: Observations) -> None:
    """Assert that every agent's action lies within its mask."""
    masks = observed.action_masks
    assert masks is not None
    assert actions.shape == observed.alive.shape
    assert np.take_along_axis(masks, actions[..., None], axis=-1)[..., 0][observed.alive].all()
