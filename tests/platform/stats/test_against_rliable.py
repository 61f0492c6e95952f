"""Statistics of scores equal rliable's on the same data; intervals, whose draws are random, nearly so."""

import numpy as np
import pytest
from numpy.typing import NDArray
from rliable import library, metrics

from headway.stats.scores import (
    interquartile_mean,
    performance_profile,
    probability_of_improvement,
    sample_efficiency,
)

Scores = NDArray[np.float64]
pytestmark = pytest.mark.filterwarnings("ignore:random_state is deprecated:FutureWarning")
SHAPES = [(7, 3), *(pytest.param(*shape, marks=pytest.mark.slow) for shape in ((10, 1), (50, 4)))]


def drawn(runs: int, tasks: int, seed: int = 0) -> Scores:
    """Draw scores, each task on its own scale, rounded so that some are equal."""
    generator = np.random.default_rng(seed)
    return np.round(generator.normal(generator.uniform(0, 3, tasks), 1.0, (runs, tasks)), 1)


def by_task(scores: Scores) -> list[Scores]:
    return list(scores.T)


@pytest.mark.parametrize(("runs", "tasks"), SHAPES)
def test_interquartile_means_and_their_intervals(runs: int, tasks: int) -> None:
    scores = drawn(runs, tasks)
    _, found = library.get_interval_estimates(
        {"a": scores},
        lambda x: np.array([metrics.aggregate_iqm(x)]),
        reps=5_000,
        random_state=np.random.RandomState(1),
    )
    low, high = found["a"][:, 0]
    ours = interquartile_mean(by_task(scores))
    assert ours.estimate == pytest.approx(metrics.aggregate_iqm(scores))
    assert (ours.low, ours.high) == pytest.approx((low, high), abs=0.08 * (high - low))


@pytest.mark.parametrize(("runs", "tasks"), SHAPES)
def test_probabilities_of_improvement_and_their_intervals(runs: int, tasks: int) -> None:
    a, b = drawn(runs, tasks, 1), drawn(runs + 2, tasks, 2)
    ours = probability_of_improvement(by_task(a), by_task(b), resamples=5_000)
    assert ours.estimate == pytest.approx(metrics.probability_of_improvement(a, b))
    _, found = library.get_interval_estimates(
        {"a,b": (a, b)},
        lambda x, y: np.array([metrics.probability_of_improvement(x, y)]),
        reps=400,  # each is a Mann-Whitney test
        random_state=np.random.RandomState(2),
    )
    low, high = found["a,b"][:, 0]
    assert (ours.low, ours.high) == pytest.approx((low, high), abs=0.2 * (high - low))


def test_equal_scores_are_no_improvement() -> None:
    scores = drawn(6, 2)
    ours = probability_of_improvement(by_task(scores), by_task(scores))
    assert ours.estimate == metrics.probability_of_improvement(scores, scores) == 0.5


def test_performance_profiles_and_their_intervals() -> None:
    scores, thresholds = drawn(20, 3), np.linspace(-1, 5, 13)
    shares, found = library.create_performance_profile({"a": scores}, thresholds, reps=2_000)
    ours = performance_profile(by_task(scores), thresholds)
    np.testing.assert_allclose(ours.estimate, shares["a"])
    np.testing.assert_allclose(np.stack([ours.low, ours.high]), found["a"], atol=0.04)


@pytest.mark.slow
def test_sample_efficiency_is_the_interquartile_mean_along_the_curve() -> None:
    """The data are those of rliable's example: the metric at each frame, with whole runs resampled."""
    generator = np.random.default_rng(3)
    curves = np.cumsum(generator.normal(1, 1, (12, 2, 5)), axis=-1)  # runs x tasks x points
    frames, found = library.get_interval_estimates(
        {"a": curves},
        lambda x: np.array([metrics.aggregate_iqm(x[..., point]) for point in range(x.shape[-1])]),
        reps=4_000,
    )
    ours = sample_efficiency([curves[:, task] for task in range(2)], resamples=4_000)
    np.testing.assert_allclose(ours.estimate, frames["a"])
    width = found["a"][1] - found["a"][0]
    np.testing.assert_allclose(ours.low, found["a"][0], atol=0.1 * width.max())
    np.testing.assert_allclose(ours.high, found["a"][1], atol=0.1 * width.max())
