"""Returns between asynchronous decisions, on bus days with holding times as actions."""

import numpy as np
import pytest
from numpy.typing import NDArray

from headway_algos.on_policy.gae import generalised_advantages
from headway_envs.bus.config import BusConfig, RewardConfig
from headway_envs.bus.env import BusBatchedEnv
from headway_envs.bus.prepare import prepare

STEPS, COPIES = 240, 2
"""A day has 180 intervals: it ends on the way."""


@pytest.fixture(scope="module")
def rollout() -> dict[str, NDArray[np.generic]]:
    """Return rewards, terminated and acting (T, C, N), alive (T + 1, C, N) and the times (T + 1, C), s."""
    config = BusConfig(control="holding", control_every=3, end_hour=8, reward=RewardConfig(scope="own"))
    env = BusBatchedEnv(prepare(config), COPIES)
    draw = np.random.default_rng(0)
    observed = env.reset(np.arange(COPIES, dtype=np.uint64))
    rows: dict[str, list[NDArray[np.generic]]] = {
        name: [] for name in ("rewards", "terminated", "acting", "alive", "time")
    }
    for _ in range(STEPS):
        rows["alive"].append(observed.alive.copy())
        rows["time"].append(env.world.days["now"].copy())
        outcome, observed = env.step(draw.integers(0, 7, observed.alive.shape))
        for name in ("rewards", "terminated", "acting"):
            rows[name].append(getattr(outcome, name).copy())
    return {name: np.stack(values) for name, values in rows.items()}


def test_a_decision_is_credited_with_discounted_rewards_up_to_the_next(
    rollout: dict[str, NDArray[np.generic]],
) -> None:
    """A loop over decisions alone: the return of one is the rewards until the next, each discounted by its
    distance in time, and the next one's return, discounted by gamma to the power of the minutes between.
    With lambda 1 the advantage is that minus the value; values between decisions cancel."""
    gamma, draw = 0.97, np.random.default_rng(1)
    rewards, terminated = rollout["rewards"].astype(np.float64), rollout["terminated"].astype(np.bool_)
    alive = np.concatenate([rollout["alive"], np.ones((1, *rewards.shape[1:]), np.bool_)]).astype(np.bool_)
    values = draw.normal(size=alive.shape)
    no = np.zeros_like(terminated)
    advantages = generalised_advantages(
        rewards, values, np.zeros(rewards.shape), terminated, no, alive, gamma, 1.0
    )
    spans = []
    for c in range(COPIES):
        for n in range(rewards.shape[2]):
            returns, end = values[STEPS, c, n], STEPS
            for t in reversed(range(STEPS)):
                if terminated[t, c, n]:
                    returns, end = 0.0, t + 1
                if not rollout["acting"][t, c, n]:
                    continue
                minutes = [
                    round(float(rollout["time"][s, c] - rollout["time"][t, c]) / 60.0) for s in range(t, end)
                ]
                earned = sum(
                    gamma**after * reward for after, reward in zip(minutes, rewards[t:end, c, n], strict=True)
                )
                returns = earned + gamma ** (end - t) * returns
                assert advantages[t, c, n] == pytest.approx(returns - values[t, c, n], abs=1e-9)
                spans.append(end - t)
                end = t
    assert len(set(spans)) > 5  # asynchronous: decisions lie 1 to many minutes apart
    assert len(spans) > 300
