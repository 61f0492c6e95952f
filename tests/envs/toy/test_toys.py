"""The toy environments have the returns that they document."""

import numpy as np
import pytest
from numpy.typing import NDArray

from headway.contracts import BatchedEnv, EnvEntry
from headway_envs.toy.entry import ENTRIES
from headway_envs.toy.matrix import MatrixConfig
from headway_envs.toy.recall import RecallConfig
from headway_envs.toy.tracking import SPEED, Tracking, TrackingConfig, regulator
from headway_envs.toy.trivial import TrivialConfig
from headway_envs.toy.visitors import VisitorsConfig


def seeds(count: int) -> NDArray[np.uint64]:
    return np.arange(count, dtype=np.uint64)


def run_rule(
    entry: EnvEntry, config: object, rule_name: str, copies: int, steps: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return rewards (T, C, N) and metrics (episodes, M) of the finished episodes."""
    prepared = entry.prepare(config)
    env: BatchedEnv = entry.make(prepared, copies)
    rule = entry.rules[rule_name].make(prepared)
    observed, rewards, metrics = env.reset(seeds(copies)), [], []
    for _ in range(steps):
        outcome, observed = env.step(rule.act(env, observed))
        rewards.append(outcome.rewards.astype(np.float64))
        metrics.append(outcome.metrics[outcome.episode_ended].copy())
    return np.array(rewards), np.concatenate(metrics)


def test_trivial_pays_one_for_the_right_actions_and_a_third_for_random_ones() -> None:
    config = TrivialConfig(agents=5, steps=30)
    rewards, metrics = run_rule(ENTRIES["trivial"], config, "optimal", copies=4, steps=60)
    assert (rewards == 1).all()
    assert (metrics == 1).all()
    rewards, _ = run_rule(ENTRIES["trivial"], config, "random", copies=50, steps=60)
    assert rewards.mean() == pytest.approx(1 / 3, abs=4 * np.sqrt(2 / 9 / (50 * 60 * 5)))


def test_matrix_pays_the_entry_of_the_joint_action() -> None:
    env = ENTRIES["matrix"].make(MatrixConfig(payoff=((1.0, 2.0), (3.0, 4.0))), 4)
    env.reset(seeds(4))
    outcome, _ = env.step(np.array([[0, 0], [0, 1], [1, 0], [1, 1]]))
    np.testing.assert_array_equal(outcome.rewards, [[1, 1], [2, 2], [3, 3], [4, 4]])
    np.testing.assert_array_equal(outcome.metrics[:, 0], [0, 0, 0, 1])
    assert outcome.terminated.all()
    assert not outcome.truncated.any()


def test_the_climbing_game_is_worth_eleven() -> None:
    rewards, metrics = run_rule(ENTRIES["matrix"], MatrixConfig(), "optimal", copies=3, steps=5)
    assert (rewards == 11).all()
    assert (metrics == 1).all()


def test_recall_pays_one_per_episode_for_the_cue_shown_at_its_first_step_only() -> None:
    config = RecallConfig(agents=4, steps=5, cues=3)
    rewards, metrics = run_rule(ENTRIES["recall"], config, "optimal", copies=6, steps=20)
    assert (rewards.reshape(4, 5, 6, 4) == [[[[0]], [[0]], [[0]], [[0]], [[1]]]]).all()
    assert (metrics == 1).all()
    rewards, _ = run_rule(ENTRIES["recall"], config, "random", copies=100, steps=50)
    assert rewards.sum(axis=0).mean() / 10 == pytest.approx(1 / 3, abs=4 * np.sqrt(2 / 9 / 4000))
    env = ENTRIES["recall"].make(config, 6)
    shown = [env.reset(seeds(6)).observations.copy()]
    shown += [env.step(np.zeros((6, 4), dtype=np.int64))[1].observations.copy() for _ in range(4)]
    np.testing.assert_array_equal(shown[0][..., :3].argmax(axis=-1), env.cues)  # type: ignore[attr-defined]  # a Recall
    assert all((step[..., :3] == 0).all() for step in shown[1:])
    assert [step[..., 3].mean() for step in shown] == [0, 0, 0, 0, 1]
    assert len(np.unique(shown[0][..., :3].argmax(axis=-1))) == 3


def least_cost(offset: float, velocity: float, config: TrackingConfig) -> float:
    """Return the noiseless optimum from one least-squares problem over all actions."""
    steps = config.steps
    moved = np.tril(np.ones((steps, steps)))
    unmoved = offset + velocity * np.arange(1, steps + 1)
    matrix = np.vstack([moved, np.sqrt(config.effort) * np.eye(steps)])
    target = np.concatenate([unmoved, np.zeros(steps)])
    actions = np.linalg.lstsq(matrix, target, rcond=None)[0]
    return float(((matrix @ actions - target) ** 2).sum())


@pytest.mark.parametrize("effort", [0.0, 0.1, 3.0])
def test_the_regulator_of_tracking_is_the_least_squares_optimum(effort: float) -> None:
    config = TrackingConfig(effort=effort, noise=0.0, agents=1, steps=20)
    _, values = regulator(config)
    for offset, velocity in [(1.0, SPEED), (-0.4, 0.07), (0.0, -SPEED)]:
        p, q, s = values[0]
        closed = p * offset**2 + 2 * q * offset * velocity + s * velocity**2
        assert closed == pytest.approx(least_cost(offset, velocity, config), abs=1e-9)


def test_the_optimal_rule_of_tracking_earns_the_closed_form() -> None:
    config = TrackingConfig()
    _, values = regulator(config)
    copies = 400
    env = Tracking(config, copies)
    start = env.reset(seeds(copies)).observations.astype(np.float64)
    offset, velocity = np.split(start, 2, axis=-1)
    p, q, s = values[0]
    noise = 2 * ((1 + values[1:, 0]) * config.noise**2 / 3).sum()
    expected = (p * offset**2 + 2 * q * offset * velocity + s * velocity**2).sum(axis=-1) + noise
    rewards, _ = run_rule(ENTRIES["tracking"], config, "optimal", copies, config.steps)
    surplus = -rewards.sum(axis=0) - expected
    # Noise is independent between agents, so there are C x N independent samples.
    assert abs(surplus.mean()) < 4 * surplus.std() / np.sqrt(surplus.size)


@pytest.mark.parametrize("effort", [0.0, 0.1, 1.0, 10.0])
def test_the_optimum_of_tracking_stays_within_the_bounds_of_actions(effort: float) -> None:
    config = TrackingConfig(effort=effort, noise=0.1, steps=200)
    gains, _ = regulator(config)
    for sign in (-1.0, 1.0):
        offset, velocity = 1.0, sign * SPEED
        for on_offset, on_velocity in gains:
            action = on_offset * offset + on_velocity * velocity
            assert abs(action) < 2
            offset += velocity - action + config.noise


def test_tracking_clips_actions_to_their_bounds() -> None:
    one, other = Tracking(TrackingConfig(), 1), Tracking(TrackingConfig(), 1)
    one.reset(seeds(1))
    other.reset(seeds(1))
    wild = one.step(np.full((1, 3, 2), 50.0, dtype=np.float32))[0].rewards
    np.testing.assert_array_equal(wild, other.step(np.full((1, 3, 2), 2.0, dtype=np.float32))[0].rewards)


def test_the_optimal_rule_of_visitors_has_no_regret_and_the_random_one_no_disallowed_choice() -> None:
    _, metrics = run_rule(ENTRIES["visitors"], VisitorsConfig(), "optimal", copies=6, steps=200)
    np.testing.assert_allclose(metrics[:, 0], 0, atol=1e-6)
    _, metrics = run_rule(ENTRIES["visitors"], VisitorsConfig(), "random", copies=6, steps=200)
    assert (metrics[:, 0] > 0).all()
    assert (metrics[:, 1] == 0).all()


def test_visitors_charge_and_count_a_choice_that_is_not_allowed() -> None:
    env = ENTRIES["visitors"].make(VisitorsConfig(), 2)
    observed = env.reset(seeds(2))
    for _ in range(40):
        assert observed.action_masks is not None
        forbidden = observed.action_masks.argmin(axis=-1)
        broken = ~np.take_along_axis(observed.action_masks, forbidden[..., None], axis=-1)[..., 0]
        outcome, observed = env.step(forbidden)
        wrong = broken & outcome.acting
        assert (outcome.rewards[wrong] == -1).all()
        assert (outcome.rewards[~outcome.acting] == 0).all()


def test_visitors_cover_every_case_of_the_masks() -> None:
    env = ENTRIES["visitors"].make(VisitorsConfig(), 8)
    env.reset(seeds(8))
    returned = idle = retired = terminated = truncated = False
    alive = np.zeros((8, 6), dtype=np.bool_)
    for _ in range(300):
        before = alive.copy()
        outcome, observed = env.step(np.zeros((8, 6), dtype=np.int64))
        alive = observed.alive.copy()
        running = ~outcome.episode_ended
        assert np.isnan(observed.observations[~alive]).all(), "absent rows are NaN on purpose"
        returned |= bool((alive & ~before)[running].any())
        idle |= bool((before & ~outcome.acting)[running].any())
        retired |= bool(outcome.terminated[running].any())
        terminated |= bool(outcome.terminated[~running].all(axis=-1).any())
        truncated |= bool(outcome.truncated[~running].any())
    assert returned
    assert idle
    assert retired
    assert terminated
    assert truncated


@pytest.mark.parametrize("name", ["trivial", "tracking", "visitors"])
def test_episodes_differ_from_each_other(name: str) -> None:
    entry = ENTRIES[name]
    env = entry.make(entry.config(), 2)
    first = env.reset(seeds(2)).states.copy()
    actions = entry.rules["random"].make(entry.config())
    observed = env.reset(seeds(2))
    while True:
        outcome, observed = env.step(actions.act(env, observed))
        if outcome.episode_ended[0]:
            break
    assert not np.array_equal(first[0], first[1])
    assert not np.array_equal(first[0], observed.states[0])
