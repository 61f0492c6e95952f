"""Running statistics that forget, against weighted means over all rows."""

import io
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from made_trajectories import fabricate
from numpy.typing import NDArray

from headway.contracts import Discrete, EnvSpec
from headway_algos.config import ModelConfig
from headway_algos.networks.normalisation import RunningStatistics
from headway_algos.on_policy.critics.return_regression import RETURN_BATCHES, RETURN_MEMORY, RETURN_SHARE
from headway_algos.on_policy.learner import OnPolicyLearner
from headway_algos.registry import configure

SIZES = (30, 4, 0, 200, 1, 60)


def _batches(networks: int) -> list[tuple[torch.Tensor, NDArray[np.bool_]]]:
    draw = np.random.default_rng(0)
    made = []
    for i, size in enumerate(SIZES):
        rows = draw.normal(5.0 * i, 10.0 / (i + 1), (networks, size, 2))
        made.append((torch.from_numpy(rows), draw.random((networks, size)) < 0.7))
    return made


@pytest.mark.parametrize(
    ("memory", "batches", "share"),
    [(10.0, 0.0, 0.0), (50.0, 0.0, 0.0), (10.0, 1.5, 0.0), (10.0, 0.1, 0.5), (np.inf, 0.0, 0.0)],
)
def test_rows_weigh_less_with_every_batch(memory: float, batches: float, share: float) -> None:
    """Rows that outweigh all bounds are scaled to the largest one."""
    moments = RunningStatistics(3, 2, memory, batches, share)
    rows: list[NDArray[Any]] = [np.empty((0, 2)) for _ in range(3)]
    weights: list[NDArray[Any]] = [np.empty(0) for _ in range(3)]
    for batch, selected in _batches(3):
        moments.include(batch, selected)
        for p in range(3):
            own = batch[p].numpy()[selected[p]]
            bound = max(memory, batches * len(own), share * len(rows[p]))
            before = weights[p] * min(1.0, bound / max(weights[p].sum(), 1.0))
            rows[p], weights[p] = np.concatenate([rows[p], own]), np.append(before, np.ones(len(own)))
            mean = np.average(rows[p], axis=0, weights=weights[p])
            variance = np.average((rows[p] - mean) ** 2, axis=0, weights=weights[p])
            np.testing.assert_allclose(moments.mean[p, 0], mean, rtol=1e-12)
            np.testing.assert_allclose(moments.variance[p, 0], variance, rtol=1e-10)


def test_pooled_statistics_are_those_of_all_rows_of_a_group() -> None:
    """Network 2 has seen no rows; network 3 is alone in its group."""
    moments, rows = RunningStatistics(4, 2), [np.empty((0, 2)) for _ in range(4)]
    for batch, selected in _batches(4):
        selected[2] = False
        moments.include(batch, selected)
        for p in range(4):
            rows[p] = np.concatenate([rows[p], batch[p].numpy()[selected[p]]])
    moments.pool(np.array([7, 7, 7, 1]))
    for members, p in (((0, 1, 2), 0), ((0, 1, 2), 2), ((3,), 3)):
        seen = np.concatenate([rows[member] for member in members])
        assert float(moments.count[p]) == len(seen)
        np.testing.assert_allclose(moments.mean[p, 0], seen.mean(axis=0), rtol=1e-12)
        np.testing.assert_allclose(moments.variance[p, 0], seen.var(axis=0), rtol=1e-10)


def test_statistics_follow_shrinking_values() -> None:
    """After 30 batches a tenth as large as the first, within 10%."""
    moments = RunningStatistics(1, 1, RETURN_MEMORY, RETURN_BATCHES, RETURN_SHARE)
    draw = np.random.default_rng(1)
    for scale in [10.0] + [1.0] * 30:
        moments.include(torch.from_numpy(scale * draw.normal(size=(1, 4096, 1))))
    assert float(moments.std[0, 0, 0]) == pytest.approx(1, rel=0.1)


def test_statistics_cover_a_day_of_short_batches() -> None:
    """Returns follow the time of day, with 20 batches per day. After 30 days, mean and deviation are those of
    whole days, not of the last hours."""
    moments = RunningStatistics(1, 1, RETURN_MEMORY, RETURN_BATCHES, RETURN_SHARE)
    for batch in range(2000):
        level = 10 * np.sin(2 * np.pi * batch / 20)
        moments.include(torch.full((1, 2000, 1), level, dtype=torch.float64))
        if batch > 600:
            assert abs(float(moments.mean[0, 0, 0])) < 2.5
            assert float(moments.std[0, 0, 0]) == pytest.approx(10 / np.sqrt(2), rel=0.1)


def test_statistics_stored_with_equal_weights_are_restored_and_then_forgotten() -> None:
    old, new = RunningStatistics(1, 1), RunningStatistics(1, 1, 1000.0, share=0.1)
    old.include(
        torch.full((1, 100_000, 1), 7.0, dtype=torch.float64) + torch.arange(100_000)[None, :, None] % 2
    )
    file = io.BytesIO()
    torch.save(old.state_dict(), file)
    file.seek(0)
    new.load_state_dict(torch.load(file, weights_only=True))
    assert torch.equal(new.mean, old.mean)
    assert torch.equal(new.std, old.std)
    for _ in range(60):
        new.include(torch.zeros(1, 4000, 1, dtype=torch.float64))
    assert abs(float(new.mean[0, 0, 0])) < 0.01


def test_returns_are_normalised_by_recent_ones() -> None:
    """The limit on earlier batches also holds when training continues from a checkpoint."""
    spec, draw = EnvSpec("made", ("a",), 1, Discrete(2)), np.random.default_rng(2)
    settings = configure("ippo", model=ModelConfig((4,)), epochs=1, minibatches=1)
    learner = OnPolicyLearner(settings, spec, (1,), "cpu")
    estimate = learner.critic.estimate(fabricate(spec, 128, 16, seed=0), learner.behaviour, 1)
    for iteration, scale in enumerate([10.0] + [1.0] * 30, start=1):
        returns = scale * draw.normal(size=estimate.returns.shape)
        learner.critic.fit(replace(estimate, returns=returns), iteration)
        resumed = OnPolicyLearner(settings, spec, (1,), "cpu")
        resumed.load_state_dict(learner.state_dict())
        learner = resumed
    std = learner.critic.state_dict()["networks"]["return_moments.variance"].sqrt()
    assert float(std) == pytest.approx(1, rel=0.1)
